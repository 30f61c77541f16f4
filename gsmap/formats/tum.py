"""Write TUM trajectories, which most evaluation tools read: ``timestamp tx ty tz qx qy qz qw`` per line."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from gsmap.durable import write_text_output
from gsmap.errors import InputError
from gsmap.geometry.rotations import matrices_to_quats
from gsmap.texts import escaped
from gsmap.types import Sim3


def write_trajectory(
    path: str | os.PathLike[str],
    poses: Sequence[Sim3],
    timestamps_s: Sequence[float] | None,
    names: Sequence[str],
    remarks: Sequence[str] = (),
) -> None:
    """Write poses in order, at ``timestamps_s`` or at 0, 1, 2, ... seconds; drop scales, which the format cannot store.

    Args:
        names: Names of the poses, written as comment lines before the poses.
        remarks: Comment lines at the start of the file.
    """
    times = range(len(poses)) if timestamps_s is None else timestamps_s
    if len(times) != len(poses):
        raise InputError(f"{len(poses)} poses but {len(times)} timestamps", code="shape_mismatch")
    if len(names) != len(poses):
        raise InputError(f"{len(poses)} poses but {len(names)} names", code="shape_mismatch")
    lines = ["# timestamp tx ty tz qx qy qz qw", *(f"# {escaped(remark)}" for remark in remarks)]
    for i, (time_s, pose) in enumerate(zip(times, poses, strict=True)):
        lines.append(f"# {escaped(names[i])}")
        w, x, y, z = matrices_to_quats(pose.rotation[None])[0].tolist()
        lines.append(" ".join(repr(v) for v in [float(time_s), *pose.translation.tolist(), x, y, z, w]))
    write_text_output(Path(path), "\n".join(lines) + "\n")

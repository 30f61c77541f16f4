"""Read and write TUM trajectories, which most evaluation tools read: ``timestamp tx ty tz qx qy qz qw`` per line."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsmap.durable import write_text_output
from gsmap.errors import InputError, NotFoundError
from gsmap.geometry.rotations import matrices_to_quats, quats_to_matrices
from gsmap.texts import escaped
from gsmap.types import Sim3


def read_trajectory(path: str | os.PathLike[str]) -> list[tuple[float, Sim3]]:
    """Read timestamps in seconds and poses ``T_map_scene``, in file order; ``#`` starts a comment.

    Raises:
        NotFoundError: The file is missing.
        InputError: A line (named) without eight finite numbers, or whose quaternion is not a rotation.
    """
    path = Path(path)
    if not path.is_file():
        raise NotFoundError(f"no trajectory at {path}", code="file_not_found")
    out = []
    with path.open(encoding="ascii", errors="replace") as lines:
        for number, line in enumerate(lines, 1):
            words = line.split("#", 1)[0].replace(",", " ").split()
            if not words:
                continue
            try:
                values = [float(word) for word in words]
            except ValueError:
                values = []
            if len(values) != 8 or not all(math.isfinite(v) for v in values):
                raise InputError(
                    f"{path} line {number}: a TUM pose needs 8 finite numbers: time, position, quaternion",
                    code="invalid_line",
                )
            x, y, z, w = values[4:]
            if not 0.5 < x * x + y * y + z * z + w * w < 2:
                raise InputError(
                    f"{path} line {number}: the quaternion {values[4:]} is not a rotation", code="not_a_rotation"
                )
            out.append((values[0], Sim3(quats_to_matrices(np.array([w, x, y, z])), np.array(values[1:4]))))
    return out


def write_trajectory(
    path: str | os.PathLike[str],
    poses: Sequence[Sim3],
    timestamps_s: Sequence[float] | None = None,
    names: Sequence[str] | None = None,
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
    if names is not None and len(names) != len(poses):
        raise InputError(f"{len(poses)} poses but {len(names)} names", code="shape_mismatch")
    lines = ["# timestamp tx ty tz qx qy qz qw", *(f"# {escaped(remark)}" for remark in remarks)]
    for i, (time_s, pose) in enumerate(zip(times, poses, strict=True)):
        if names is not None:
            lines.append(f"# {escaped(names[i])}")
        w, x, y, z = matrices_to_quats(pose.rotation[None])[0].tolist()
        lines.append(" ".join(repr(v) for v in [float(time_s), *pose.translation.tolist(), x, y, z, w]))
    write_text_output(Path(path), "\n".join(lines) + "\n")

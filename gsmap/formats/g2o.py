"""Write pose graphs as ``.g2o`` (``VERTEX_SE3:QUAT`` and ``EDGE_SE3:QUAT``), for exchange with other solvers.

``VERTEX_SE3:QUAT id x y z qx qy qz qw`` and ``EDGE_SE3:QUAT i j x y z qx qy qz qw`` followed by the 21 numbers of the
upper triangle, row by row, of a 6x6 information matrix ordered [translation, rotation]. ``i j`` measures the pose of j
in the frame of i. The rotation part is taken as radians of the tangent, as gtsam and most datasets do.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from gsmap.durable import write_text_output
from gsmap.errors import InputError
from gsmap.geometry.rotations import matrices_to_quats
from gsmap.geometry.similarities import without_scale
from gsmap.texts import escaped
from gsmap.types import Edge, Sim3

_SWAP = np.array([3, 4, 5, 0, 1, 2])
_UPPER = np.triu_indices(6)


def write_graph(
    path: str | os.PathLike[str],
    poses: Mapping[str, Sim3],
    edges: Sequence[Edge],
    names: Mapping[str, str],
    remarks: Sequence[str] = (),
) -> None:
    """Write poses and edges. As g2o requires integer ids, scenes are numbered in the order of ``poses``.

    The scale row of the information is left out.

    Args:
        names: Names of scenes by id, written as comment lines before the vertices.
        remarks: Comment lines at the start of the file.

    Raises:
        InputError: A pose or edge with a scale, which the format lacks, or an edge to a scene without a pose.
    """
    numbers = {scene: k for k, scene in enumerate(poses)}
    lines = [f"# {escaped(remark)}" for remark in remarks]
    for scene, pose in poses.items():
        lines.append(f"# {escaped(names[scene])}")
        lines.append(f"VERTEX_SE3:QUAT {numbers[scene]} {_values(pose, f'scene {scene}')}")
    for edge in edges:
        name = f"edge {edge.target}:{edge.source}"
        if edge.target not in numbers or edge.source not in numbers:
            raise InputError(
                f"{name} refers to a scene without a pose: write all scenes of the component", code="unsupported_output"
            )
        information = without_scale(np.asarray(edge.information, dtype=np.float64))[np.ix_(_SWAP, _SWAP)]
        upper = " ".join(repr(float(v)) for v in information[_UPPER])
        ends = f"{numbers[edge.target]} {numbers[edge.source]}"
        lines.append(f"EDGE_SE3:QUAT {ends} {_values(edge.S_target_source, name)} {upper}")
    write_text_output(Path(path), "\n".join(lines) + "\n")


def _values(pose: Sim3, name: str) -> str:
    if not pose.is_rigid:
        raise InputError(
            f"{name} has scale {pose.scale:.6g}, which .g2o cannot store: export rigid components only",
            code="unsupported_output",
        )
    w, x, y, z = matrices_to_quats(pose.rotation[None])[0].tolist()
    return " ".join(repr(v) for v in [*pose.translation.tolist(), x, y, z, w])

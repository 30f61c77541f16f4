"""Read and write pose graphs as ``.g2o`` (``VERTEX_SE3:QUAT`` and ``EDGE_SE3:QUAT``), for exchange with other solvers.

``VERTEX_SE3:QUAT id x y z qx qy qz qw`` and ``EDGE_SE3:QUAT i j x y z qx qy qz qw`` followed by the 21 numbers of the
upper triangle, row by row, of a 6x6 information matrix ordered [translation, rotation]. ``i j`` measures the pose of j
in the frame of i. The rotation part is taken as radians of the tangent, as gtsam and most datasets do.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gsmap.durable import write_text_output
from gsmap.errors import InputError, NotFoundError
from gsmap.geometry.rotations import matrices_to_quats, quats_to_matrices
from gsmap.geometry.similarities import without_scale
from gsmap.texts import escaped
from gsmap.types import Edge, Sim3

# Certainty of the log scale of a rigid edge: stiff beside any measurement.
STIFF = 1e10
_SWAP = np.array([3, 4, 5, 0, 1, 2])
_UPPER = np.triu_indices(6)


@dataclass(frozen=True, eq=False)
class G2o:
    """The content of a pose graph file: the scenes with their poses, in file order, the edges, and the fixed scenes."""

    poses: dict[str, Sim3] = field(default_factory=dict)
    edges: tuple[Edge, ...] = ()
    fixed: tuple[str, ...] = ()


def read_graph(path: str | os.PathLike[str], *, confirmed: bool = True) -> G2o:
    """Read a 3D pose graph.

    Args:
        confirmed: Mark all edges as confirmed, so that robust optimization never excludes them.

    Raises:
        NotFoundError: The file is missing.
        InputError: An invalid line (named), a vertex type other than SE(3), or a repeated vertex.
    """
    path = Path(path)
    if not path.is_file():
        raise NotFoundError(f"no pose graph at {path}", code="file_not_found")
    poses: dict[str, Sim3] = {}
    edges: list[Edge] = []
    fixed: list[str] = []
    with path.open(encoding="ascii", errors="replace") as lines:
        for number, line in enumerate(lines, 1):
            words = line.split()
            if not words or words[0].startswith("#"):
                continue
            where = f"{path} line {number}"
            if words[0] == "FIX":
                fixed += words[1:]
            elif words[0] == "VERTEX_SE3:QUAT":
                name, values = _split(words, 1, 7, where)
                if name[0] in poses:
                    raise InputError(f"{where}: vertex {name[0]} appears a second time", code="duplicate")
                poses[name[0]] = _pose(values, where)
            elif words[0] == "EDGE_SE3:QUAT":
                (target, source), values = _split(words, 2, 28, where)
                information = np.zeros((6, 6))
                information[_UPPER] = values[7:]
                information += np.triu(information, 1).T
                full = np.diag([0.0] * 6 + [STIFF])
                full[:6, :6] = information[np.ix_(_SWAP, _SWAP)]
                edges.append(Edge(target, source, _pose(values[:7], where), full, confirmed=confirmed))
            else:
                raise InputError(
                    f"{where}: {words[0]} is not an SE(3) vertex or edge; only 3D pose graphs are read",
                    code="invalid_line",
                )
    for edge in edges:
        for scene in (edge.target, edge.source):
            if scene not in poses:
                poses[scene] = Sim3.identity()
    return G2o(poses, tuple(edges), tuple(fixed))


def write_graph(
    path: str | os.PathLike[str],
    poses: Mapping[str, Sim3],
    edges: Sequence[Edge],
    fixed: Sequence[str] = (),
    names: Mapping[str, str] | None = None,
    remarks: Sequence[str] = (),
) -> dict[str, int]:
    """Write poses and edges. As g2o requires integer ids, scenes are numbered in the order of ``poses``.

    Ids that are whole numbers already are kept where all are. The scale row of the information is left out.

    Args:
        names: Names of scenes by id, written as comment lines before the vertices.
        remarks: Comment lines at the start of the file.

    Returns:
        The number of each scene.

    Raises:
        InputError: A pose or edge with a scale, which the format lacks, or an edge to a scene without a pose.
    """
    numeric = all(s.isascii() and s.isdigit() and str(int(s)) == s for s in poses)
    numbers = {scene: int(scene) if numeric else k for k, scene in enumerate(poses)}
    lines = [f"# {escaped(remark)}" for remark in remarks]
    for scene, pose in poses.items():
        if names is not None:
            lines.append(f"# {escaped(names[scene])}")
        lines.append(f"VERTEX_SE3:QUAT {numbers[scene]} {_values(pose, f'scene {scene}')}")
    lines += [f"FIX {numbers[scene]}" for scene in fixed]
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
    return numbers


def _split(words: list[str], names: int, count: int, where: str) -> tuple[list[str], list[float]]:
    if len(words) != 1 + names + count:
        raise InputError(f"{where}: {words[0]} needs {names + count} values, has {len(words) - 1}", code="invalid_line")
    try:
        values = [float(word) for word in words[1 + names :]]
    except ValueError as problem:
        raise InputError(f"{where}: {problem}", code="invalid_line") from None
    if not all(math.isfinite(v) for v in values):
        raise InputError(f"{where} holds NaN or infinity", code="not_finite")
    return words[1 : 1 + names], values


def _pose(values: list[float], where: str) -> Sim3:
    x, y, z, w = values[3:7]
    if not 0.5 < x * x + y * y + z * z + w * w < 2:
        raise InputError(f"{where}: the quaternion {values[3:7]} is not a rotation", code="not_a_rotation")
    return Sim3(quats_to_matrices(np.array([w, x, y, z])), np.array(values[:3]))


def _values(pose: Sim3, name: str) -> str:
    if not pose.is_rigid:
        raise InputError(
            f"{name} has scale {pose.scale:.6g}, which .g2o cannot store: export rigid components only",
            code="unsupported_output",
        )
    w, x, y, z = matrices_to_quats(pose.rotation[None])[0].tolist()
    return " ".join(repr(v) for v in [*pose.translation.tolist(), x, y, z, w])

"""Read the pose graphs and trajectories that other programs publish and `gsmap poses` writes; the files are trusted."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsmap.geometry.rotations import quats_to_matrices
from gsmap.types import Edge, Sim3

_STIFF = 1e10  # certainty of the log scale of a rigid edge: stiff beside any measurement


@dataclass(frozen=True, eq=False)
class PoseGraphFile:
    """The content of a ``.g2o`` file: poses in file order, edges, and the fixed vertices."""

    poses: dict[str, Sim3]
    edges: list[Edge]
    fixed: list[str]


def read_g2o(path: Path, *, confirmed: bool = True) -> PoseGraphFile:
    """Read a 3D pose graph.

    Args:
        path: file with vertices and edges of SE(3); a vertex without a line has the identity.
        confirmed: mark all edges as confirmed, so that robust optimization never excludes them.
    """
    found = PoseGraphFile({}, [], [])
    for words in map(str.split, path.read_text().splitlines()):
        kind = words[0] if words else "#"
        if kind == "FIX":
            found.fixed.extend(words[1:])
        elif kind == "VERTEX_SE3:QUAT":
            found.poses[words[1]] = _pose(words[2:])
        elif kind == "EDGE_SE3:QUAT":
            upper = np.zeros((6, 6))
            upper[np.triu_indices(6)] = [float(word) for word in words[10:]]
            information = np.diag([0.0] * 6 + [_STIFF])
            swap = np.ix_([3, 4, 5, 0, 1, 2], [3, 4, 5, 0, 1, 2])
            information[:6, :6] = (upper + np.triu(upper, 1).T)[swap]
            found.edges.append(Edge(words[1], words[2], _pose(words[3:10]), information, confirmed=confirmed))
    for edge in found.edges:
        for scene in (edge.target, edge.source):
            found.poses.setdefault(scene, Sim3.identity())
    return found


def read_tum(path: Path) -> list[tuple[float, Sim3]]:
    """Read the timestamps in seconds and poses of a TUM trajectory, in file order."""
    lines = [line.split() for line in path.read_text().splitlines() if line and not line.startswith("#")]
    return [(float(words[0]), _pose(words[1:])) for words in lines]


def _pose(words: list[str]) -> Sim3:
    tx, ty, tz, x, y, z, w = map(float, words)
    return Sim3(quats_to_matrices(np.array([w, x, y, z])), np.array([tx, ty, tz]))

"""What a map keeps of its retrieval: which scenes an index holds, and what it said of those that asked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Member:
    """A scene of an index.

    Args:
        scene: its id.
        graph: key of the graph that its nodes are of; in an index of views, of its features, and nothing more is said.
        upright: whether the third coordinate of its nodes is their height.
        metric: whether its unit is, or may be, the metre.
        coarseness: metres that look like one does in a room (`SceneGraph.working_m`).
    """

    scene: str
    graph: str
    upright: bool = True
    metric: bool = True
    coarseness: float = 1.0


@dataclass(frozen=True, eq=False)
class IndexArrays:
    """The nodes of an index's segment, in lists.

    Args:
        keys: (W,) int64 rising, of the lists.
        starts: (W + 1,) int64 where each begins among the nodes.
        nodes: (M, B) uint8 a node's code, position, and the place of its scene among the members.
    """

    keys: np.ndarray
    starts: np.ndarray
    nodes: np.ndarray


@dataclass(frozen=True)
class Candidate:
    """A scene that may show a place of the one that asked.

    Args:
        scene: its id.
        score: by how much more lies alike in both scenes than is usual of scenes that lie there, in deviations.
        votes: what all matches say.
    """

    scene: str
    score: float
    votes: float

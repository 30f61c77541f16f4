"""Index entries and retrieval results that a map stores."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class IndexedScene:
    """A scene in an inverted index.

    Args:
        scene: scene id.
        graph: key of the graph of its nodes; in a view index, key of its features.
        upright: true if the third coordinate of its nodes is height.
        metric: true if its unit is, or may be, the metre.
        coarseness: working metres per unit (`SceneGraph.working_m`).
    """

    scene: str
    graph: str
    upright: bool = True
    metric: bool = True
    coarseness: float = 1.0


@dataclass(frozen=True, eq=False)
class IndexArrays:
    """The inverted lists of an index segment.

    Args:
        keys: (W,) int64 ascending keys of the lists.
        starts: (W + 1,) int64 start of each list.
        nodes: (M, B) uint8 code, position, and index of the node's scene.
    """

    keys: np.ndarray
    starts: np.ndarray
    nodes: np.ndarray


@dataclass(frozen=True)
class Candidate:
    """A candidate scene for a query.

    Args:
        scene: scene id.
        score: z-score of the verified similarity, relative to neighbouring scenes.
        votes: tf-idf score.
    """

    scene: str
    score: float
    votes: float

"""Pack the nodes of many scenes into a segment of an inverted index."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmap.retrieve.codes import NUM_DIMS
from gsmap.retrieve.scene_nodes import WIDTH, Nodes, SceneNodes
from gsmap.types.segments import InMemory, in_lists, write_places

_POSITIONS = slice(NUM_DIMS, NUM_DIMS + 6)


def positions_of(rows: np.ndarray) -> np.ndarray:
    """Return the (M, 3) float16 positions of the nodes in (M, WIDTH) uint8 rows of a segment."""
    return np.ascontiguousarray(rows[:, _POSITIONS]).view("<f2")


def new_segment(scenes: Sequence[SceneNodes]) -> InMemory:
    """Build an index segment of scenes that are not indexed yet."""
    keys = np.concatenate([v.index_nodes.keys for v in scenes]) if scenes else np.zeros(0, np.int64)
    rows = [_pack(v.index_nodes, place) for place, v in enumerate(scenes)]
    return in_lists([v.member for v in scenes], keys, np.concatenate(rows) if rows else np.zeros((0, WIDTH), np.uint8))


def _pack(nodes: Nodes, place: int) -> np.ndarray:
    rows = np.empty((len(nodes), WIDTH), np.uint8)
    rows[:, :NUM_DIMS] = nodes.codes.view(np.uint8)
    rows[:, _POSITIONS] = np.ascontiguousarray(nodes.positions.astype("<f2")).view(np.uint8).reshape(-1, 6)
    write_places(rows, place)
    return rows

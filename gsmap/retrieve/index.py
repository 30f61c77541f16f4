"""The nodes of many scenes as they lie in an index."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmap.retrieve.codes import NUM_DIMS
from gsmap.retrieve.voters import WIDTH, Nodes, Voters
from gsmap.types.segments import InMemory, in_lists, write_places

_POSITIONS = slice(NUM_DIMS, NUM_DIMS + 6)


def positions_of(rows: np.ndarray) -> np.ndarray:
    """(M, 3) float16 where the nodes in (M, WIDTH) uint8 rows of a segment lie."""
    return np.ascontiguousarray(rows[:, _POSITIONS]).view("<f2")


def new_segment(voters: Sequence[Voters]) -> InMemory:
    """A segment of scenes that are not in any."""
    keys = np.concatenate([v.kept.keys for v in voters]) if voters else np.zeros(0, np.int64)
    rows = [_packed(v.kept, place) for place, v in enumerate(voters)]
    return in_lists([v.member for v in voters], keys, np.concatenate(rows) if rows else np.zeros((0, WIDTH), np.uint8))


def _packed(nodes: Nodes, place: int) -> np.ndarray:
    rows = np.empty((len(nodes), WIDTH), np.uint8)
    rows[:, :NUM_DIMS] = nodes.codes.view(np.uint8)
    rows[:, _POSITIONS] = np.ascontiguousarray(nodes.positions.astype("<f2")).view(np.uint8).reshape(-1, 6)
    write_places(rows, place)
    return rows

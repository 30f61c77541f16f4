"""Segments of an inverted index: immutable inverted lists, which are merged as the index grows (log-structured).

A row is bytes of which the last four say whose it is: the place of its scene among the segment's members.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gsmap.errors import CorruptError
from gsmap.types.retrieval import IndexArrays, IndexedScene

LEVEL = 16
"""Ratio of segment sizes: an index has at most one segment between two neighbouring powers of this number of scenes."""

PLACE_BYTES = 4


class Segment(Protocol):
    """A part of an inverted index, such as one on disk.

    Args:
        members: its scenes; None for scenes that no longer count.
        num_nodes: number of rows.
    """

    @property
    def members(self) -> Sequence[IndexedScene | None]: ...
    @property
    def num_nodes(self) -> int: ...

    def lists(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the ascending keys of the lists (W,) int64, and the first row of each list (W + 1,) int64."""
        ...

    def rows(self, start: int, stop: int) -> np.ndarray:
        """Return the rows from ``start`` to ``stop`` as a (stop - start, B) uint8 array."""
        ...


@dataclass(frozen=True, eq=False)
class InMemory:
    """A segment in memory."""

    members: Sequence[IndexedScene | None]
    arrays: IndexArrays

    @property
    def num_nodes(self) -> int:
        return len(self.arrays.nodes)

    def lists(self) -> tuple[np.ndarray, np.ndarray]:
        return self.arrays.keys, self.arrays.starts

    def rows(self, start: int, stop: int) -> np.ndarray:
        return self.arrays.nodes[start:stop]


def in_lists(members: Sequence[IndexedScene | None], keys: np.ndarray, rows: np.ndarray) -> InMemory:
    """Build a segment from rows (M, B) uint8 and the list key (M,) of each row."""
    order = np.argsort(keys, kind="stable")
    names, counts = np.unique(keys, return_counts=True)
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return InMemory(members, IndexArrays(names, starts, rows[order]))


def places_of(rows: np.ndarray, num_members: int) -> np.ndarray:
    """Return the index (M,) int32 among the members of each row's scene.

    Raises:
        CorruptError: a row of a scene that is not there.
    """
    places = np.ascontiguousarray(rows[:, -PLACE_BYTES:]).view("<i4")[:, 0]
    if len(places) and not (places.min() >= 0 and places.max() < num_members):
        raise CorruptError("the index has rows of unknown scenes", code="index_damaged")
    return places


def write_places(rows: np.ndarray, places: np.ndarray | int) -> None:
    """Set the scene index in rows (M, B) uint8, in place."""
    held = np.broadcast_to(np.asarray(places, "<i4"), len(rows))
    rows[:, -PLACE_BYTES:] = np.ascontiguousarray(held)[:, None].view(np.uint8)


def merged(segments: Iterable[Segment]) -> InMemory:
    """Merge segments into one; drop scenes that were removed from the index."""
    members: list[IndexedScene | None] = []
    keys, parts = [], []
    for segment in segments:
        names, starts = lists_of(segment)
        rows = np.array(segment.rows(0, int(starts[-1])))
        count = len(segment.members)
        new_place = np.full(count, -1, dtype=np.int64)
        for place, member in enumerate(segment.members):
            if member is not None:
                new_place[place] = len(members)
                members.append(member)
        places = new_place[places_of(rows, count)]
        write_places(rows, places)
        keys.append(np.repeat(names, np.diff(starts))[places >= 0])
        parts.append(rows[places >= 0])
    return in_lists(members, np.concatenate(keys), np.concatenate(parts))


def to_merge(sizes: Sequence[int], added: int) -> list[int]:
    """Choose the segments to merge with a new one, so that at most one segment of each size class remains.

    Args:
        sizes: number of scenes of each segment.
        added: number of scenes of the new segment.

    Returns:
        Their places among ``sizes``.
    """
    chosen: list[int] = []
    total = added
    for place in sorted(range(len(sizes)), key=lambda k: sizes[k]):
        if _level(sizes[place]) <= _level(total):
            chosen.append(place)
            total += sizes[place]
    return sorted(chosen)


def lists_of(segment: Segment) -> tuple[np.ndarray, np.ndarray]:
    """Return the lists of a segment (see `Segment.lists`) after checking that they lie within its rows.

    Raises:
        CorruptError: no segment has such.
    """
    keys, starts = segment.lists()
    sound = (
        keys.dtype == starts.dtype == np.int64
        and keys.ndim == starts.ndim == 1
        and len(starts) == len(keys) + 1
        and starts[0] == 0
        and starts[-1] == segment.num_nodes
        and (np.diff(starts) >= 0).all()
        and (np.diff(keys) > 0).all()
    )
    if not sound:
        raise CorruptError("the index has invalid lists", code="index_damaged")
    return keys, starts


def _level(size: int) -> int:
    level = 0
    while size >= LEVEL:
        size //= LEVEL
        level += 1
    return level

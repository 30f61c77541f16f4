"""An index: the nodes of many scenes in lists, in a few segments that are never changed, only made anew as one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gsmap.errors import CorruptError
from gsmap.retrieve.codes import NUM_DIMS
from gsmap.retrieve.voters import WIDTH, Nodes, Voters
from gsmap.types.retrieval import IndexArrays, Member

LEVEL = 16
"""A segment holds from a power of this many scenes to the next; there is at most one of each size."""

_POSITIONS = slice(NUM_DIMS, NUM_DIMS + 6)
_PLACE = slice(NUM_DIMS + 6, WIDTH)


class Segment(Protocol):
    """A part of an index, as it lies on a disk.

    Args:
        members: its scenes; None in the place of one that does not count (any more).
        num_nodes: how many rows there are.
    """

    @property
    def members(self) -> Sequence[Member | None]: ...
    @property
    def num_nodes(self) -> int: ...

    def lists(self) -> tuple[np.ndarray, np.ndarray]:
        """(W,) int64 rising keys of its lists, and (W + 1,) int64 where each begins in the rows."""
        ...

    def rows(self, start: int, stop: int) -> np.ndarray:
        """(stop - start, WIDTH) uint8."""
        ...


@dataclass(frozen=True, eq=False)
class InMemory:
    """A segment that lies in memory."""

    members: Sequence[Member | None]
    arrays: IndexArrays

    @property
    def num_nodes(self) -> int:
        return len(self.arrays.nodes)

    def lists(self) -> tuple[np.ndarray, np.ndarray]:
        return self.arrays.keys, self.arrays.starts

    def rows(self, start: int, stop: int) -> np.ndarray:
        return self.arrays.nodes[start:stop]


@dataclass(frozen=True, eq=False)
class Unpacked:
    """M nodes of many scenes.

    Args:
        places: (M,) int32 the scene of each among the members.
    """

    codes: np.ndarray
    positions: np.ndarray
    places: np.ndarray


def unpacked(rows: np.ndarray) -> Unpacked:
    """What lies in (M, WIDTH) uint8 rows."""
    rows = np.ascontiguousarray(rows)
    return Unpacked(
        rows[:, :NUM_DIMS].view(np.int8),
        np.ascontiguousarray(rows[:, _POSITIONS]).view("<f2"),
        np.ascontiguousarray(rows[:, _PLACE]).view("<i4")[:, 0],
    )


def new_segment(voters: Sequence[Voters]) -> InMemory:
    """A segment of scenes that are not in any."""
    keys = np.concatenate([v.kept.keys for v in voters]) if voters else np.zeros(0, np.int64)
    rows = [_packed(v.kept, place) for place, v in enumerate(voters)]
    return _sorted([v.member for v in voters], keys, np.concatenate(rows) if rows else np.zeros((0, WIDTH), np.uint8))


def merged(segments: Iterable[Segment]) -> InMemory:
    """One segment of what counts in several."""
    members: list[Member | None] = []
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
        places = new_place[checked_places(unpacked(rows).places, count)]
        rows[:, _PLACE] = places.astype("<i4")[:, None].view(np.uint8)
        keys.append(np.repeat(names, np.diff(starts))[places >= 0])
        parts.append(rows[places >= 0])
    return _sorted(members, np.concatenate(keys), np.concatenate(parts))


def to_merge(sizes: Sequence[int], added: int) -> list[int]:
    """Which segments a new one is to become one with, so that of each size there is one; by the scenes that count.

    Args:
        sizes: of the segments that there are.
        added: scenes of the new one.

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
    """`Segment.lists`, none of which leads outside of the rows.

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
        raise CorruptError("the lists of a retrieval index make no sense")
    return keys, starts


def checked_places(places: np.ndarray, num_members: int) -> np.ndarray:
    """The places of scenes, each of which there is.

    Raises:
        CorruptError: a node of a scene that is not there.
    """
    if len(places) and not (places.min() >= 0 and places.max() < num_members):
        raise CorruptError("a retrieval index has nodes of scenes that it has not")
    return places


def _level(size: int) -> int:
    level = 0
    while size >= LEVEL:
        size //= LEVEL
        level += 1
    return level


def _packed(nodes: Nodes, place: int) -> np.ndarray:
    rows = np.empty((len(nodes), WIDTH), np.uint8)
    rows[:, :NUM_DIMS] = nodes.codes.view(np.uint8)
    rows[:, _POSITIONS] = np.ascontiguousarray(nodes.positions.astype("<f2")).view(np.uint8).reshape(-1, 6)
    rows[:, _PLACE] = np.full((len(nodes), 1), place, "<i4").view(np.uint8)
    return rows


def _sorted(members: list[Member | None], keys: np.ndarray, rows: np.ndarray) -> InMemory:
    order = np.argsort(keys, kind="stable")
    names, counts = np.unique(keys, return_counts=True)
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return InMemory(members, IndexArrays(names, starts, rows[order]))

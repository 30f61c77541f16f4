"""Associate segments of several scenes: segments that fill the same cells in the same colour are one object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.geometry.cells import cell_labels, group_means

CELL_M = 0.12
"""Edge of the cells by which segments are compared, in metres."""

_MIN_OVERLAP_OF_LARGER = 0.2  # two segments of one object share at least this fraction of the larger segment's cells
_MAX_LAB = 15.0  # largest median difference of their colours, after exposure balancing
_MIN_IOU = 0.4  # with at least this IoU the colours may differ, because the object was painted
_AHEAD = 3  # number of later scenes with which a segment is compared, so that the cost is linear in scenes


SegmentId = tuple[int, int]
"""Indices (scene, segment) of a segment."""


@dataclass(frozen=True, eq=False)
class PlacedSegments:
    """The segments of one scene in the map frame.

    Args:
        points: (K, 3) float64 sample points of the segments, in metres.
        segments: (K,) int segment of each point.
        lab: (K, 3) colours of the points, in L*a*b*.
        count: M, number of segments.
    """

    points: np.ndarray
    segments: np.ndarray
    lab: np.ndarray
    count: int


def fuse(
    captures: Sequence[PlacedSegments],
    moved: Sequence[tuple[SegmentId, SegmentId]] = (),
    parted: Sequence[tuple[SegmentId, int]] = (),
    min_overlap: float = 0.45,
) -> list[tuple[SegmentId, ...]]:
    """Group segments into objects, with at most one segment of each scene per object; each segment is in one group.

    Two segments are joined if, by shared cells, each is the best match of the other and both agree in size and colour;
    the best matches are joined first. Scenes far apart in the given order are not compared directly.

    Args:
        captures: segments of the scenes in order of time, in one frame.
        moved: pairs of segments of one moved object; these are joined first.
        parted: pairs of a segment and the index of a scene that does not show the segment in place.
        min_overlap: smallest fraction in [0, 1] of the smaller segment's cells that lie in the cells of the larger
            segment.

    Returns:
        Groups sorted by their first segment; the segments of a group are sorted by scene.
    """
    first, cells, lab = _cells(captures)
    home = np.searchsorted(first, np.arange(first[-1]), "right") - 1
    sizes = np.bincount(cells[:, 1], minlength=first[-1])
    a, b, shared, differ = _overlaps(cells, lab, home)
    smaller, larger = np.minimum(sizes[a], sizes[b]), np.maximum(sizes[a], sizes[b])
    union = sizes[a] + sizes[b] - shared
    fits = (shared >= min_overlap * smaller) & (shared >= _MIN_OVERLAP_OF_LARGER * larger)
    fits &= (differ < _MAX_LAB) | (shared >= _MIN_IOU * union)
    a, b, score = a[fits], b[fits], (shared / np.maximum(larger, 1))[fits]
    best = _mutual(a, b, score, home)
    order = np.argsort(-score[best], kind="stable")
    edges = [(first[p[0]] + p[1], first[q[0]] + q[1]) for p, q in moved]
    edges += list(zip(a[best][order].tolist(), b[best][order].tolist(), strict=True))
    groups = _join_groups(edges, home, {(int(first[c] + t), other) for (c, t), other in parted}, len(moved))
    return [tuple((int(home[n]), int(n - first[home[n]])) for n in group) for group in groups]


def _cells(captures: Sequence[PlacedSegments]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the (C + 1,) first node of each scene, the unique sorted rows (cell, node), and the mean colours of these
    rows."""
    first = np.concatenate([[0], np.cumsum([capture.count for capture in captures])]).astype(np.int64)
    points = np.concatenate([capture.points for capture in captures]).reshape(-1, 3)
    lab = np.concatenate([capture.lab for capture in captures]).reshape(-1, 3)
    nodes = np.concatenate([first[i] + capture.segments for i, capture in enumerate(captures)]).astype(np.int64)
    label, _ = cell_labels(np.floor(points / CELL_M))
    cells, row, counts = np.unique(np.column_stack([label, nodes]), axis=0, return_inverse=True, return_counts=True)
    return first, cells, group_means(lab, row.reshape(-1), counts)


def _overlaps(
    cells: np.ndarray, lab: np.ndarray, home: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return pairs of nodes of different scenes that share cells, the number of shared cells, and the median colour
    difference."""
    parts, offs = [], []
    for ahead in range(1, 2 * _AHEAD + 1):  # nodes are sorted by scene; two nodes of one scene may share a cell
        same = np.flatnonzero(cells[:-ahead, 0] == cells[ahead:, 0])
        same = same[home[cells[same, 1]] != home[cells[same + ahead, 1]]]
        parts.append(np.column_stack([cells[same, 1], cells[same + ahead, 1]]))
        offs.append(lab[same] - lab[same + ahead])
    pairs, off = np.concatenate(parts), np.concatenate(offs)
    captures = home[pairs]
    for i, j in np.unique(captures, axis=0):  # exposure balancing
        both = (captures == (i, j)).all(1)
        off[both] -= np.median(off[both], axis=0)
    found, label, shared = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
    order = np.lexsort((np.linalg.norm(off, axis=1), label.reshape(-1)))
    middle = np.concatenate([[0], np.cumsum(shared)[:-1]]) + shared // 2
    differ = np.linalg.norm(off, axis=1)[order][middle] if len(found) else np.zeros(0)
    return found[:, 0], found[:, 1], shared, differ


def _mutual(a: np.ndarray, b: np.ndarray, score: np.ndarray, home: np.ndarray) -> np.ndarray:
    """Return the rows of pairs in which each node is the best match of the other."""
    best: dict[tuple[int, int], int] = {}
    for row in np.argsort(score, kind="stable"):
        best[int(a[row]), int(home[b[row]])] = int(row)
        best[int(b[row]), int(home[a[row]])] = int(row)
    mutual = [
        row
        for row in range(len(a))
        if best[int(a[row]), int(home[b[row]])] == row == best[int(b[row]), int(home[a[row]])]
    ]
    return np.array(mutual, np.int64)


def _join_groups(
    edges: Sequence[tuple[int, int]], home: np.ndarray, parted: set[tuple[int, int]], moved: int
) -> list[list[int]]:
    """Join nodes to groups by edges in order; the first ``moved`` edges belong to moved objects.

    An edge is skipped if it would give a group two nodes of one scene. Unless it belongs to a moved object, it is also
    skipped if it would add a node of a scene that does not show another node of the group.
    """
    group = {n: [n] for n in range(len(home))}
    for i, (p, q) in enumerate(edges):
        one, other = group[p], group[q]
        if i >= moved and any((n, home[m]) in parted or (m, home[n]) in parted for n in one for m in other):
            continue
        if one is other or {home[n] for n in one} & {home[n] for n in other}:
            continue
        both = sorted(one + other)
        for n in both:
            group[n] = both
    return [members for n, members in group.items() if members[0] == n]

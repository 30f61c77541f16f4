"""Which things of several captures are one: those that fill the same cells of the map in the same colour."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.geometry.cells import cell_labels, group_means

_CELL_M = 0.12  # edge of the cells that segments are compared by
_MIN_OVERLAP_OF_LARGER = 0.2  # fraction of the larger segment's cells that two segments of one object share
_MAX_LAB = 15.0  # median difference of their colours, after exposure balancing
_MIN_IOU = 0.4  # from which on the colours may differ: the object was painted
_AHEAD = 3  # a thing is compared with those of so many later captures at its place: linear in captures, few gaps


Node = tuple[int, int]
"""(capture, thing), both by index."""


@dataclass(frozen=True, eq=False)
class Placed:
    """The things of one capture in the frame of the map.

    Args:
        points: (K, 3) float64 metres, of members of things.
        things: (K,) int which.
        lab: (K, 3) their colours, L*a*b*.
        count: M, how many things there are.
    """

    points: np.ndarray
    things: np.ndarray
    lab: np.ndarray
    count: int


def fuse(
    captures: Sequence[Placed],
    moved: Sequence[tuple[Node, Node]] = (),
    parted: Sequence[tuple[Node, int]] = (),
    min_overlap: float = 0.45,
) -> list[tuple[Node, ...]]:
    """Groups of things that are one object, at most one of each capture; each thing is in one.

    Two things are one where each is the other's best match by shared cells and they agree in size and colour; the
    surest matches are taken first. The order of the captures matters only for which of those that are far apart in it
    are compared at all.

    Args:
        captures: in order of time, one frame.
        moved: things that are known to be one though they stood elsewhere; these are taken first.
        parted: things, each with a capture that is known not to show it where it stood.

    Returns:
        Groups by their first node; nodes within by capture.
    """
    first, cells, lab = _cells(captures, _CELL_M)
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
    groups = _joined(edges, home, {(int(first[c] + t), other) for (c, t), other in parted}, len(moved))
    return [tuple((int(home[n]), int(n - first[home[n]])) for n in group) for group in groups]


def _cells(captures: Sequence[Placed], cell_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where each capture's nodes begin (C + 1,), rows (cell, node), each once, sorted; and the mean colour in each."""
    first = np.concatenate([[0], np.cumsum([capture.count for capture in captures])]).astype(np.int64)
    points = np.concatenate([capture.points for capture in captures]).reshape(-1, 3)
    lab = np.concatenate([capture.lab for capture in captures]).reshape(-1, 3)
    nodes = np.concatenate([first[i] + capture.things for i, capture in enumerate(captures)]).astype(np.int64)
    label, _ = cell_labels(np.floor(points / cell_m))
    cells, row, counts = np.unique(np.column_stack([label, nodes]), axis=0, return_inverse=True, return_counts=True)
    return first, cells, group_means(lab, row.reshape(-1), counts)


def _overlaps(
    cells: np.ndarray, lab: np.ndarray, home: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of nodes of different captures that share cells, how many, and how much colours differ in most of these."""
    parts, offs = [], []
    for ahead in range(1, 2 * _AHEAD + 1):  # nodes come by capture; two of one capture may share a cell
        same = np.flatnonzero(cells[:-ahead, 0] == cells[ahead:, 0])
        same = same[home[cells[same, 1]] != home[cells[same + ahead, 1]]]
        parts.append(np.column_stack([cells[same, 1], cells[same + ahead, 1]]))
        offs.append(lab[same] - lab[same + ahead])
    pairs, off = np.concatenate(parts), np.concatenate(offs)
    captures = home[pairs]
    for i, j in np.unique(captures, axis=0):  # another exposure is not another thing
        both = (captures == (i, j)).all(1)
        off[both] -= np.median(off[both], axis=0)
    found, label, shared = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
    order = np.lexsort((np.linalg.norm(off, axis=1), label.reshape(-1)))
    middle = np.concatenate([[0], np.cumsum(shared)[:-1]]) + shared // 2
    differ = np.linalg.norm(off, axis=1)[order][middle] if len(found) else np.zeros(0)
    return found[:, 0], found[:, 1], shared, differ


def _mutual(a: np.ndarray, b: np.ndarray, score: np.ndarray, home: np.ndarray) -> np.ndarray:
    """Rows of the pairs in which each is the other's best in its capture."""
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


def _joined(
    edges: Sequence[tuple[int, int]], home: np.ndarray, parted: set[tuple[int, int]], moved: int
) -> list[list[int]]:
    """Groups of nodes that edges join, in this order, the first of them of what moved.

    An edge is left that would give a group two of one capture, or, of what stayed, one of a capture that does not show
    another.
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

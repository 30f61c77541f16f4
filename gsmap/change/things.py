"""From changed cells to changed things."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from gsmap.change.params import Params
from gsmap.change.sides import Side

_SMOOTH_M = 0.08  # neighbours that a cell asks
_FEWEST_LOOKS = 3  # views through a neighbourhood, and pixels that compared its colour
_FAINT = 0.6  # strength from which a cell may belong to something that changed its colour ...
_CLEAR = 1.0  # ... of which some cells are at least that strong
_ATTACHED = 0.5  # share of a change of colour that lies by a thing which came or went, so that it is part of it


@dataclass(frozen=True, eq=False)
class Cells:
    """What is known of the cells of one capture, after each has asked its neighbours.

    Args:
        moved: (M,) bool, the other capture looked through.
        painted: (M,) bool, on the other's surface, in another colour.
        strength: (M,) of the difference of colour, as a multiple of what counts.
        offset_m: (M,) of the other's surface behind this one.
    """

    moved: np.ndarray
    painted: np.ndarray
    strength: np.ndarray
    offset_m: np.ndarray


def judge(side: Side, params: Params) -> Cells:
    """Which cells changed, and how."""
    through, on = side.around(side.through, _SMOOTH_M), side.around(side.on, _SMOOTH_M)
    moved = (through >= _FEWEST_LOOKS) & (through >= params.min_share * (through + on))
    moved &= side.through >= side.on
    looks = side.around(side.looks, _SMOOTH_M)
    strength = side.around(side.strength * side.looks, _SMOOTH_M) / np.maximum(looks, 1)
    offset_looks = side.around(side.offset_looks, _SMOOTH_M)
    offset = side.around(side.offset_m * side.offset_looks, _SMOOTH_M) / np.maximum(offset_looks, 1)
    painted = ~moved & (looks >= _FEWEST_LOOKS) & (strength >= _FAINT)
    return Cells(moved, painted, strength, offset)


@dataclass(frozen=True, eq=False)
class Thing:
    """Cells of both captures that changed together.

    Args:
        older, newer: (K,) cells that came or went.
        older_paint, newer_paint: (K,) cells that changed their colour.
    """

    older: np.ndarray
    newer: np.ndarray
    older_paint: np.ndarray
    newer_paint: np.ndarray

    def num(self) -> int:
        return len(self.older) + len(self.newer)


_NONE = np.zeros(0, dtype=np.int64)


def components(points: np.ndarray, reach_m: float) -> np.ndarray:
    """(N,) label of the cluster of each point: those within reach of each other are of one."""
    if not len(points):
        return np.zeros(0, np.int64)
    pairs = cKDTree(points).query_pairs(reach_m, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(points),) * 2)
    labels: np.ndarray = connected_components(graph, directed=False)[1].astype(np.int64)
    return labels


def groups(points: np.ndarray, rows: np.ndarray, reach_m: float, fewest: int) -> list[np.ndarray]:
    """The rows of points by cluster, large ones first, those of fewer than ``fewest`` cells left out."""
    labels = components(points[rows], reach_m)
    found = [rows[labels == k] for k in range(int(labels.max(initial=-1)) + 1)]
    return sorted((g for g in found if len(g) >= fewest), key=lambda g: (-len(g), int(g[0])))


def find_things(sides: tuple[Side, Side], cells: tuple[Cells, Cells], params: Params) -> list[Thing]:
    """Things that went, things that came, and things that changed their colour, each by itself."""
    fewest = max(2, round(params.min_area_m2 / params.cell_m**2))
    things = [
        Thing(g, _NONE, _NONE, _NONE)
        for g in groups(sides[0].points, np.flatnonzero(cells[0].moved), params.reach_m, fewest)
    ]
    things += [
        Thing(_NONE, g, _NONE, _NONE)
        for g in groups(sides[1].points, np.flatnonzero(cells[1].moved), params.reach_m, fewest)
    ]
    painted = _painted(sides, cells, params)
    return _attach(things, painted, sides)


def _painted(sides: tuple[Side, Side], cells: tuple[Cells, Cells], params: Params) -> list[Thing]:
    """Clusters of both captures' cells that changed their colour."""
    rows = [np.flatnonzero(c.painted) for c in cells]
    points = np.concatenate([side.points[r] for side, r in zip(sides, rows, strict=True)])
    strength = np.concatenate([c.strength[r] for c, r in zip(cells, rows, strict=True)])
    fewest = max(2, round(params.min_colour_area_m2 / params.cell_m**2))
    found = []
    for group in groups(points, np.arange(len(points)), params.reach_m, fewest):
        clear = int((strength[group] >= _CLEAR).sum())
        if clear * 2 < fewest:
            continue
        older = rows[0][group[group < len(rows[0])]]
        newer = rows[1][group[group >= len(rows[0])] - len(rows[0])]
        if min(len(older), len(newer)) * 4 >= fewest:  # Both captures show it.
            found.append(Thing(_NONE, _NONE, older, newer))
    return found


def _attach(things: list[Thing], painted: list[Thing], sides: tuple[Side, Side]) -> list[Thing]:
    """Changes of colour that lie by a thing which came or went become part of it: its back, or what it left behind."""
    if not things:
        return painted
    points = [np.concatenate([sides[0].points[t.older], sides[1].points[t.newer]]) for t in things]
    owner = np.repeat(np.arange(len(things)), [len(p) for p in points])
    tree = cKDTree(np.concatenate(points))
    left = []
    for paint in painted:
        at = np.concatenate([sides[0].points[paint.older_paint], sides[1].points[paint.newer_paint]])
        distance, row = tree.query(at, distance_upper_bound=0.15)
        near = np.isfinite(distance)
        if near.mean() < _ATTACHED:
            left.append(paint)
            continue
        k = int(np.bincount(owner[row[near]]).argmax())
        things[k] = replace(
            things[k],
            older_paint=np.union1d(things[k].older_paint, paint.older_paint),
            newer_paint=np.union1d(things[k].newer_paint, paint.newer_paint),
        )
    return things + left

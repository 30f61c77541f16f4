"""From changed cells to changed things."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from gsmap.change.params import Params
from gsmap.change.sides import CELL_M, Side
from gsmap.compare.components import components, groups
from gsmap.compare.structure import planes
from gsmap.geometry.cells import cell_labels

_MIN_LOOKED_THROUGH = 0.5  # fraction of the views of a neighbourhood, for it to count as gone
_CLUSTER_LINK_M = 0.1  # changed cells this near belong to one segment
_MIN_PAINT = 1.9  # strength of a change of colour that is reported, times the least difference of colour
_MAX_LEAK = 0.2  # fraction of it that goes on around its edges; that of light and shadow is larger
_SMOOTH_M = 0.08  # neighbours that a cell asks
_FEWEST_LOOKS = 3  # views through a neighbourhood, and pixels that compared its colour
_FAINT = 0.6  # strength from which a cell may belong to something that changed its colour
_WHOLE = 0.33  # of a thing of which this share of what was judged has changed, all has
_BOX_M = 0.1  # ... but not what lies farther than this beyond all that has
_SAME_M = 0.15  # ... nor what is the same as ever and lies farther from what changed
_LINK_M = 0.08  # cells of one thing, where nothing but the room's shell is between things
_RING_M = (0.04, 0.12)  # how far from a change of colour its surroundings begin and end
_MOST = 0.35
_MUCH, _MANY = 0.25, 100  # of a thing, and cells: so much of it does not change its colour by a shadow
_PLACE_M = 0.5
_DARK = 0.8  # a change that is lightness to this share may be a shadow, a lamp, or a window at night
_COHERENT = 0.4  # one that agrees with itself less may be a texture that two trainings show differently
_BEHIND_M = 0.2  # a change of colour on a wall, so close to a thing that came or went, is its back or its shadow
_BEHIND = 0.5  # ... if this share of it is
_SPLINTER, _SPLINTER_M = 60, 0.15  # a thing of fewer cells, so close to a larger one, is a part of it


LIT_OTHERWISE = 0.028
"""What `light` says beyond which the whole place is lit otherwise."""


@dataclass(frozen=True, eq=False)
class Cells:
    """What is known of the cells of one capture, after each has asked its neighbours.

    Args:
        plane: (M,) of the room's shell, -1 for what is none; the same numbers in both captures.
        thing: (M,) cluster of the cells that are no shell, -1 for the shell.
        moved: (M,) bool, the other capture looked through.
        painted: (M,) bool, on the other's surface, in another colour.
        judged: (M,) bool, the other capture has looked at or through.
        strength: (M,) of the difference of colour, as a multiple of what counts.
        offset_m: (M,) of the other's surface behind this one.
    """

    plane: np.ndarray
    thing: np.ndarray
    moved: np.ndarray
    painted: np.ndarray
    judged: np.ndarray
    strength: np.ndarray
    offset_m: np.ndarray


def judge(sides: tuple[Side, Side]) -> tuple[Cells, Cells]:
    """Which cells of each capture changed, and how."""
    points = np.concatenate([side.points for side in sides])
    normals = np.concatenate([side.normals for side in sides])
    plane = planes(points, normals, CELL_M / np.sqrt(2))
    cut = len(sides[0])
    return _judge(sides[0], plane[:cut]), _judge(sides[1], plane[cut:])


def _judge(side: Side, plane: np.ndarray) -> Cells:
    through, on = side.around(side.through, _SMOOTH_M), side.around(side.on, _SMOOTH_M)
    moved = (through >= _FEWEST_LOOKS) & (through >= _MIN_LOOKED_THROUGH * (through + on)) & (side.through >= side.on)
    looks = side.around(side.looks, _SMOOTH_M)
    strength = side.around(side.strength * side.looks, _SMOOTH_M) / np.maximum(looks, 1)
    offset = side.around(side.offset_m * side.looks, _SMOOTH_M) / np.maximum(looks, 1)
    painted = ~moved & (looks >= _FEWEST_LOOKS) & (strength >= _FAINT)
    plane = np.where(moved, -1, plane)  # What one can walk through is no wall.
    thing = np.full(len(side), -1, dtype=np.int64)
    thing[plane < 0] = components(side.points[plane < 0], _LINK_M)
    judged = (side.through + side.on > 0) | (side.looks > 0)
    return Cells(plane, thing, moved, painted, judged, strength, offset)


_NONE = np.zeros(0, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class Thing:
    """What one capture shows of something that changed.

    Args:
        cells: (K,) of the whole of it.
        moved, painted: those that the other capture looked through, or saw in another colour.
        behind: cells of the shell of the room that changed their colour since it stood or stands before them.
    """

    cells: np.ndarray
    moved: np.ndarray
    painted: np.ndarray
    behind: np.ndarray = field(default_factory=lambda: _NONE)

    @property
    def changed(self) -> np.ndarray:
        return np.concatenate([self.moved, self.painted])


@dataclass(frozen=True, eq=False)
class Paint:
    """A change of colour on one surface, as both captures show it.

    Args:
        cells: of each capture.
        strength: mean, as a multiple of what counts.
        leak: share of the change that goes on around it.
        coherence: 1 where all of it changed alike, 0 where every cell did in another way.
        darkening: share of it that is lightness, not hue.
        is_shell: on a wall, floor or ceiling.
        share: of the thing it is on, in the capture where that is smaller; 0 on the shell.
        area_m2: of the surface.
    """

    cells: tuple[np.ndarray, np.ndarray]
    strength: float
    leak: float
    coherence: float
    darkening: float
    is_shell: bool
    share: float
    area_m2: float


def things_of(side: Side, cells: Cells, painted: np.ndarray, params: Params) -> list[Thing]:
    """Things of one capture that changed, largest first; ``painted`` (M,) bool are the cells of clear paint."""
    fewest = max(2, round(params.min_area_m2 / CELL_M**2))
    changed = (cells.moved | painted) & (cells.thing >= 0)
    count = max(int(cells.thing.max(initial=-1)) + 1, 1)  # one at least, for -1 to index: all may be shell
    total = np.bincount(cells.thing[cells.judged & (cells.thing >= 0)], minlength=count)
    share = np.bincount(cells.thing[changed], minlength=count) / np.maximum(total, 1)
    whole = (share >= _WHOLE)[cells.thing] & (cells.thing >= 0)
    # What is changed only in part is cut out; what is changed as a whole is kept together, within its own box.
    # A few cells of a thing so smooth that it has no more, or so little seen, are a thing together with those near.
    size = np.bincount(cells.thing[cells.thing >= 0], minlength=count)
    kind = np.where(whole & (size >= fewest)[cells.thing], cells.thing, -1)
    for thing in np.unique(kind[kind >= 0]):
        rows = np.flatnonzero(kind == thing)
        box = side.points[rows[changed[rows]]]
        outside = ((side.points[rows] < box.min(0) - _BOX_M) | (side.points[rows] > box.max(0) + _BOX_M)).any(1)
        apart = cKDTree(box).query(side.points[rows], distance_upper_bound=_SAME_M)[0]
        whole[rows[outside | (np.isinf(apart) & cells.judged[rows])]] = False
    found = []
    for group in groups(side.points, np.flatnonzero(changed | whole), _CLUSTER_LINK_M, fewest, kind):
        moved, tinted = group[cells.moved[group]], group[painted[group] & ~cells.moved[group]]
        if len(moved) + len(tinted) >= fewest:
            found.append(Thing(group, moved, tinted))
    return sorted(found, key=lambda t: (-len(t.cells), int(t.cells[0])))


def paints(sides: tuple[Side, Side], cells: tuple[Cells, Cells], params: Params) -> list[Paint]:
    """Clusters of cells, of both captures together, that changed their colour on one plane, or off all planes."""
    rows = [np.flatnonzero(c.painted) for c in cells]
    points = np.concatenate([side.points[r] for side, r in zip(sides, rows, strict=True)])
    plane = np.concatenate([c.plane[r] for c, r in zip(cells, rows, strict=True)])
    fewest = max(2, round(params.min_area_m2 / CELL_M**2))
    found = []
    for group in groups(points, np.arange(len(points)), _CLUSTER_LINK_M, fewest, plane):
        parts = rows[0][group[group < len(rows[0])]], rows[1][group[group >= len(rows[0])] - len(rows[0])]
        if min(len(parts[0]), len(parts[1])) * 4 < fewest:  # Both captures must show it.
            continue
        strengths = np.concatenate([c.strength[p] for c, p in zip(cells, parts, strict=True)])
        at = int(plane[group[0]])
        leaks = [_leak(s, c, p, at) for s, c, p in zip(sides, cells, parts, strict=True)]
        colour = np.concatenate([side.colour[p] for side, p in zip(sides, parts, strict=True)])
        looks = np.concatenate([side.looks[p] for side, p in zip(sides, parts, strict=True)])
        if not looks.any():  # All that is known of their colour is their neighbours'.
            continue
        mean, size = np.average(colour, axis=0, weights=looks), np.average(np.abs(colour), axis=0, weights=looks)
        hue, light = np.abs(mean[:2]).max(), abs(mean[2])
        found.append(
            Paint(
                parts,
                float(strengths.mean()),
                float(np.mean(leaks)),
                float(max(hue, light) / max(size.max(), 1e-6)),
                float(light / max(light + hue, 1e-6)),
                at >= 0,
                0.0 if at >= 0 else min(_share(c, p) for c, p in zip(cells, parts, strict=True)),
                len(group) / 2 * CELL_M**2,
            )
        )
    return found


def is_paint(paint: Paint, light: float) -> bool:
    """Whether a change of colour is paint, and neither light nor a texture that two trainings show differently."""
    if not paint.is_shell and paint.share >= _MUCH and sum(map(len, paint.cells)) >= _MANY:
        less = 0.6 if paint.share >= _MOST and paint.coherence >= _COHERENT else 0.75
        return paint.strength >= less * _MIN_PAINT and paint.leak <= 2.5 * _MAX_LEAK
    least = _MIN_PAINT
    if light > LIT_OTHERWISE:
        least *= 1.6
    if paint.darkening > _DARK and paint.is_shell:
        least *= 1.8
    if paint.coherence < _COHERENT:
        least *= 1.6
    return paint.strength >= least and paint.leak <= _MAX_LEAK


def light(sides: tuple[Side, Side]) -> float:
    """How unlike the light of a place falls in two captures: the robust spread, over places of half a metre, of what is
    left of the differences of colour once exposure is balanced."""
    spreads = []
    for side in sides:
        label, counts = cell_labels(np.floor(side.points / _PLACE_M))
        looks = np.bincount(label, side.looks, len(counts))
        sums = np.stack([np.bincount(label, side.colour[:, k] * side.looks, len(counts)) for k in range(3)], axis=1)
        mean = sums[looks > 0] / looks[looks > 0, None]
        if len(mean):
            spreads.append(1.4826 * np.median(np.abs(mean - np.median(mean, axis=0)), axis=0).max())
    return float(max(spreads, default=0.0))


def _share(cells: Cells, rows: np.ndarray) -> float:
    """Share of the thing most of the cells belong to that they make up."""
    if not len(rows):
        return 0.0
    thing = int(np.bincount(cells.thing[rows]).argmax())
    whole = int(((cells.thing == thing) & cells.judged).sum())
    return float((cells.thing[rows] == thing).sum() / max(whole, 1))


def _leak(side: Side, cells: Cells, inside: np.ndarray, plane: int) -> float:
    """How much of a change of colour goes on around it: paint ends at an edge, light and shadow fade."""
    if not len(inside):
        return 0.0
    around = (side.looks > 0) & ~cells.moved & ~cells.painted & (cells.plane == plane)
    outside = np.flatnonzero(around)
    distance, _ = cKDTree(side.points[inside]).query(side.points[outside], distance_upper_bound=_RING_M[1])
    ring = outside[np.isfinite(distance) & (distance > _RING_M[0])]
    if len(ring) < 6:
        return 0.0
    return float(np.median(cells.strength[ring]) / max(np.median(cells.strength[inside]), 1e-6))


def behind(things: list[Thing], sides: tuple[Side, Side], paint: Paint, which: list[int]) -> int | None:
    """The thing (its place in the list) that came or went before a change of colour on a wall, if one did.

    Args:
        which: whose capture each thing is, 0 the older and 1 the newer.
    """
    owners = [k for k, t in enumerate(things) if len(t.moved)]
    if not owners:
        return None
    points = [sides[which[k]].points[things[k].cells] for k in owners]
    owner = np.repeat(owners, [len(p) for p in points])
    at = np.concatenate([side.points[p] for side, p in zip(sides, paint.cells, strict=True)])
    distance, row = cKDTree(np.concatenate(points)).query(at, distance_upper_bound=_BEHIND_M)
    near = np.isfinite(distance)
    if near.mean() < _BEHIND:
        return None
    return int(np.bincount(owner[row[near]]).argmax())


def with_behind(thing: Thing, cells: np.ndarray) -> Thing:
    """The thing, and what changed its colour on the wall behind it."""
    return replace(thing, behind=np.union1d(thing.behind, cells))


def gathered(things: list[Thing], side: Side) -> list[Thing]:
    """Things, largest first; what is small and close to a larger one is a part of it that little was seen of."""
    left = sorted(things, key=lambda t: (-len(t.cells), int(t.cells[0])))
    kept: list[Thing] = []
    for thing in left:
        near = _nearest(thing, kept, side) if len(thing.cells) < _SPLINTER else None
        if near is None:
            kept.append(thing)
        else:
            kept[near] = joined(kept[near], thing)
    return kept


def _nearest(thing: Thing, others: list[Thing], side: Side) -> int | None:
    for k, other in enumerate(others):
        distance, _ = cKDTree(side.points[other.cells]).query(
            side.points[thing.cells], distance_upper_bound=_SPLINTER_M
        )
        if np.isfinite(distance).mean() >= 0.5:
            return k
    return None


def joined(a: Thing, b: Thing) -> Thing:
    """Two things of one capture as one."""
    return Thing(
        np.union1d(a.cells, b.cells),
        np.union1d(a.moved, b.moved),
        np.union1d(a.painted, b.painted),
        np.union1d(a.behind, b.behind),
    )


def parts(thing: Thing, rows: np.ndarray) -> tuple[Thing, Thing]:
    """The part of a thing that is made of some of its cells, and the rest."""
    inside = np.isin(thing.cells, rows)
    both = []
    for cells in (thing.cells[inside], thing.cells[~inside]):
        both.append(Thing(cells, np.intersect1d(thing.moved, cells), np.intersect1d(thing.painted, cells)))
    return both[0], replace(both[1], behind=thing.behind)

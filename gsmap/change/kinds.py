"""What kind of change a thing underwent."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from gsmap.change.sides import Side
from gsmap.change.things import Paint, Thing
from gsmap.types import Sim3
from gsmap.types.change import ChangeKind

_RING_M = 0.15  # what lies this close around a change of colour on the same plane is what it is compared with
_PLANE_M = 0.04
_STANDS_OUT = 0.45  # an edge this much fainter than in the other capture is none
_FEWEST = 6  # cells of a ring
_FLAT_M2 = 1.5  # on a wall a larger change of colour is paint and no picture
_FEWEST_MOVED, _REPAINTED = 8, 0.03  # where fewer cells, or a smaller share, were looked through, a thing was painted
_GONE = 0.5  # share of what changed that was looked through, from which a thing went or came as a whole
_ONE_PLACE = 0.4  # share of the larger footprint that both cover, if one took the other's place


@dataclass(frozen=True, eq=False)
class Found:
    """A change, before it becomes one of the report: what each capture shows of it."""

    kind: ChangeKind
    things: tuple[Thing | None, Thing | None]
    paint: Paint | None = None
    S_after_before: Sim3 | None = None
    symmetry: Literal["none", "half", "any"] = "none"
    evidence: dict[str, float] = field(default_factory=dict)


def kind_of_paint(paint: Paint, sides: tuple[Side, Side]) -> ChangeKind:
    """``disappeared`` and ``appeared`` where a flat thing's edges are gone or new, else ``recoloured``."""
    upright = np.median(np.abs(sides[0].normals[paint.cells[0], 2])) < 0.7
    if upright and paint.area_m2 > _FLAT_M2:
        return "recoloured"
    before = _edge(sides[0], paint.cells[0], sides[1], paint.cells[1])
    after = _edge(sides[1], paint.cells[1], sides[0], paint.cells[0])
    if before is None or after is None:
        return "recoloured"
    if after < _STANDS_OUT * before:
        return "disappeared"
    if before < _STANDS_OUT * after:
        return "appeared"
    return "recoloured"


def _edge(side: Side, inside: np.ndarray, other: Side, other_inside: np.ndarray) -> float | None:
    """How far colours inside differ from those around, on the same plane; None where nothing is around."""
    if not len(inside):
        return None
    changed = np.zeros(len(side), dtype=bool)
    changed[inside] = True
    if len(other_inside):
        distance, _ = cKDTree(other.points[other_inside]).query(side.points, distance_upper_bound=0.05)
        changed |= np.isfinite(distance)
    outside = np.flatnonzero(~changed)
    distance, row = cKDTree(side.points[inside]).query(side.points[outside], distance_upper_bound=_RING_M)
    near = np.isfinite(distance)
    outside, row = outside[near], row[near]
    way = side.points[outside] - side.points[inside][row]
    normals = side.normals[inside][row]
    flat = (np.abs((way * normals).sum(1)) < _PLANE_M) & (np.abs((side.normals[outside] * normals).sum(1)) > 0.8)
    outside, row = outside[flat], row[flat]
    if len(outside) < _FEWEST:
        return None
    # Cells at the very border are mixtures: those one cell farther in and out are compared.
    return float(np.median(np.linalg.norm(side.colours[outside] - _deeper(side, inside, row), axis=1)))


def _deeper(side: Side, inside: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Mean colours of the cells inside around the ones named."""
    points = side.points[inside]
    _, near = cKDTree(points).query(points[row], k=min(6, len(points)))
    near = near.reshape(len(row), -1)
    out: np.ndarray = side.colours[inside][near].mean(1)
    return out


def are_two(older: Thing, newer: Thing, both: tuple[Side, Side]) -> bool:
    """Whether what went and what came only touch: then neither took the other's place."""
    if min(len(t.moved) / max(len(t.changed), 1) for t in (older, newer)) < _GONE:
        return False
    boxes = [
        np.quantile(side.points[t.cells], (0.03, 0.97), axis=0) for side, t in zip(both, (older, newer), strict=True)
    ]
    low, high = np.maximum(boxes[0][0], boxes[1][0])[:2], np.minimum(boxes[0][1], boxes[1][1])[:2]
    shared = float(np.prod(np.maximum(high - low, 0)))
    return shared < _ONE_PLACE * max(float(np.prod((box[1] - box[0])[:2])) for box in boxes)


def kind_in_place(older: Thing | None, newer: Thing | None, both: tuple[Side, Side]) -> ChangeKind:
    """What happened where one capture or both show something that changed."""
    moved = tuple(len(t.moved) if t is not None else 0 for t in (older, newer))
    changed = sum(len(t.changed) for t in (older, newer) if t is not None)
    if sum(moved) < min(_FEWEST_MOVED, changed / 2) or sum(moved) < _REPAINTED * changed:
        return "recoloured"
    if older is None or newer is None:
        return "appeared" if older is None else "disappeared"
    # What a thing stood on or before is seen in another light without it, and is no thing in its place.
    gone = [len(t.moved) / max(len(t.changed), 1) for t in (older, newer)]
    if max(gone) >= _GONE and min(gone) < _REPAINTED:
        return "appeared" if moved[1] > moved[0] else "disappeared"
    slight = [_is_slight(a, b) for a, b in (((both[0], older), (both[1], newer)), ((both[1], newer), (both[0], older)))]
    if moved[1] > moved[0] and slight[0]:
        return "appeared"
    if moved[0] > moved[1] and slight[1]:
        return "disappeared"
    return "replaced"


def _is_slight(a: tuple[Side, Thing], b: tuple[Side, Thing]) -> bool:
    """Whether a thing is much less than another, or much flatter."""
    (side_a, thing_a), (side_b, thing_b) = a, b
    flat = np.ptp(side_a.points[thing_a.cells, 2]) < 0.3 * np.ptp(side_b.points[thing_b.cells, 2])
    return bool(flat or len(thing_a.cells) < 0.35 * len(thing_b.cells))

"""Classify changes by kind."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from gsmap.change.segments import ChangedSegment, ColourChange
from gsmap.change.surface_cells import SurfaceCells
from gsmap.types import Sim3
from gsmap.types.change import ChangeKind

_RING_M = 0.15  # width of the surroundings, on the same plane, with which a change of colour is compared
_PLANE_M = 0.04
_STANDS_OUT = 0.45  # an edge with less contrast, relative to the other capture, counts as no edge
_FEWEST = 6  # smallest number of cells in a ring
_FLAT_M2 = 1.5  # on a wall, a larger change of colour is paint, not a picture
_FEWEST_MOVED, _REPAINTED = 8, 0.03  # with fewer cells, or a smaller fraction, in free space an object was repainted
_GONE = 0.5  # an object disappeared or appeared as a whole if this fraction of its changed cells is in free space
_ONE_PLACE = 0.4  # one object replaced another if both cover at least this fraction of the larger footprint


@dataclass(frozen=True, eq=False)
class DetectedChange:
    """A detected change before it becomes an entry of the report: segments of both captures, or a change of colour."""

    kind: ChangeKind
    segments: tuple[ChangedSegment | None, ChangedSegment | None]
    paint: ColourChange | None = None
    S_after_before: Sim3 | None = None
    symmetry: Literal["none", "half", "any"] = "none"
    evidence: dict[str, float] = field(default_factory=dict)


def classify_colour_change(paint: ColourChange, sides: tuple[SurfaceCells, SurfaceCells]) -> ChangeKind:
    """Classify a change of colour: ``disappeared`` or ``appeared`` by the edges of a flat object, or ``recoloured``."""
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


def _edge(side: SurfaceCells, inside: np.ndarray, other: SurfaceCells, other_inside: np.ndarray) -> float | None:
    """Return the contrast between colours inside a change and around it on the same plane; None without
    surroundings."""
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
    # Cells at the border mix both colours, so cells one step farther in and out are compared.
    return float(np.median(np.linalg.norm(side.colours[outside] - _deeper(side, inside, row), axis=1)))


def _deeper(side: SurfaceCells, inside: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Return the mean colours of the inside cells around the given rows."""
    points = side.points[inside]
    _, near = cKDTree(points).query(points[row], k=min(6, len(points)))
    near = near.reshape(len(row), -1)
    out: np.ndarray = side.colours[inside][near].mean(1)
    return out


def are_separate(older: ChangedSegment, newer: ChangedSegment, both: tuple[SurfaceCells, SurfaceCells]) -> bool:
    """Return whether a disappeared and an appeared segment only touch, so that neither replaced the other."""
    if min(len(t.moved) / max(len(t.changed), 1) for t in (older, newer)) < _GONE:
        return False
    boxes = [
        np.quantile(side.points[t.cells], (0.03, 0.97), axis=0) for side, t in zip(both, (older, newer), strict=True)
    ]
    low, high = np.maximum(boxes[0][0], boxes[1][0])[:2], np.minimum(boxes[0][1], boxes[1][1])[:2]
    shared = float(np.prod(np.maximum(high - low, 0)))
    return shared < _ONE_PLACE * max(float(np.prod((box[1] - box[0])[:2])) for box in boxes)


def classify_in_place(
    older: ChangedSegment | None, newer: ChangedSegment | None, both: tuple[SurfaceCells, SurfaceCells]
) -> ChangeKind:
    """Classify the change at a place where one capture or both have a changed segment."""
    moved = tuple(len(t.moved) if t is not None else 0 for t in (older, newer))
    changed = sum(len(t.changed) for t in (older, newer) if t is not None)
    if sum(moved) < min(_FEWEST_MOVED, changed / 2) or sum(moved) < _REPAINTED * changed:
        return "recoloured"
    if older is None or newer is None:
        return "appeared" if older is None else "disappeared"
    # The background of a removed object is lit differently without the object, but it is no new object.
    gone = [len(t.moved) / max(len(t.changed), 1) for t in (older, newer)]
    if max(gone) >= _GONE and min(gone) < _REPAINTED:
        return "appeared" if moved[1] > moved[0] else "disappeared"
    slight = [_is_slight(a, b) for a, b in (((both[0], older), (both[1], newer)), ((both[1], newer), (both[0], older)))]
    if moved[1] > moved[0] and slight[0]:
        return "appeared"
    if moved[0] > moved[1] and slight[1]:
        return "disappeared"
    return "replaced"


def _is_slight(a: tuple[SurfaceCells, ChangedSegment], b: tuple[SurfaceCells, ChangedSegment]) -> bool:
    """Return whether a segment is much smaller or flatter than another segment."""
    (side_a, segment_a), (side_b, segment_b) = a, b
    flat = np.ptp(side_a.points[segment_a.cells, 2]) < 0.3 * np.ptp(side_b.points[segment_b.cells, 2])
    return bool(flat or len(segment_a.cells) < 0.35 * len(segment_b.cells))

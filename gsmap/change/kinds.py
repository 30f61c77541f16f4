"""What kind of change a thing underwent."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from gsmap.change.sides import Side
from gsmap.change.things import Paint
from gsmap.types.change import ChangeKind

_RING_M = 0.15  # what lies this close around a change of colour on the same plane is what it is compared with
_PLANE_M = 0.04
_STANDS_OUT = 0.45  # an edge this much fainter than in the other capture is none
_FEWEST = 6  # cells of a ring


def kind_of_paint(paint: Paint, sides: tuple[Side, Side]) -> ChangeKind:
    """``disappeared`` and ``appeared`` where a flat thing's edges are gone or new, else ``recoloured``."""
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

"""Derive spatial relations between objects: on, in and next to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations, product
from typing import Literal

import numpy as np

from gsmap.types import MapObject

_ON_M = 0.12  # largest gap between an object and the object below, as boxes enclose only the centres of Gaussians
_OVER = 0.5  # smallest fraction of its footprint over the object below
_INSIDE = 0.8  # smallest fraction of an object's box inside the object that contains it
_NEXT_M = 0.3  # largest distance in plan of objects next to each other

_GRID_M = 4.0  # edge of the cells of the floor plan in which related objects are searched for

RelationKind = Literal["on", "in", "next to"]


@dataclass(frozen=True)
class Relation:
    """The relation ``source kind target`` between the ids of two objects; ``next to`` is symmetric and given once."""

    source: str
    kind: RelationKind
    target: str


def relations(objects: Sequence[MapObject], metres: float | Mapping[int, float] = 1.0) -> list[Relation]:
    """Derive ``on``, ``in`` and ``next to`` between objects that exist at the same time, from their boxes (z up).

    Args:
        objects: objects of any components; relations hold within a component, between two present or two gone objects.
        metres: metres per unit of the map, for each component or for all.
    """
    out = []
    of = metres if isinstance(metres, Mapping) else dict.fromkeys((obj.component for obj in objects), metres)
    boxes = np.array([obj.box * of[obj.component] for obj in objects]).reshape(-1, 2, 3)
    size = np.maximum(boxes[:, 1] - boxes[:, 0], 1e-6)
    i, j = _near_pairs(boxes[:, :, :2], np.array([obj.component for obj in objects]))
    low, high = np.maximum(boxes[i, 0], boxes[j, 0]), np.minimum(boxes[i, 1], boxes[j, 1])
    overlap = np.clip(high - low, 0, None)
    volume, area = size.prod(1), size[:, :2].prod(1)
    inside, footprint = overlap.prod(1) / volume[i], overlap[:, :2].prod(1)
    over = footprint / area[i]
    apart = footprint < _OVER * np.minimum(area[i], area[j])
    gap = np.linalg.norm(np.clip(low - high, 0, None)[:, :2], axis=1)
    is_in = (inside >= _INSIDE) & (volume[j] > volume[i])
    is_on = (over >= _OVER) & (np.abs(boxes[i, 0, 2] - boxes[j, 1, 2]) < _ON_M)
    is_next = (i < j) & (overlap[:, 2] > 0) & apart
    there = np.array([obj.there for obj in objects], bool)
    for k in np.flatnonzero((gap < _NEXT_M) & (there[i] == there[j]) & (is_in | is_on | is_next)).tolist():
        kind: RelationKind = "in" if is_in[k] else "on" if is_on[k] else "next to"
        out.append(Relation(objects[i[k]].id, kind, objects[j[k]].id))
    return out


def _near_pairs(plans: np.ndarray, components: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pairs (i, j) and (j, i) of objects that share a cell of the floor plan, sorted.

    Args:
        plans: (N, 2, 2) lowest and highest corner of each object on the floor plan, in metres.
        components: (N,) component of each object.
    """
    cells: dict[tuple[int, int, int], list[int]] = {}
    low, high = (np.floor((plans[:, k] + reach) / _GRID_M).astype(int) for k, reach in ((0, -_NEXT_M), (1, _NEXT_M)))
    for n, ((x, y), (right, top)) in enumerate(zip(low.tolist(), high.tolist(), strict=True)):
        for cell in product([int(components[n])], range(x, right + 1), range(y, top + 1)):
            cells.setdefault(cell, []).append(n)
    pairs = [np.array(list(permutations(some, 2)), np.int64).reshape(-1, 2) for some in cells.values()]
    found = np.unique(np.concatenate([np.zeros((0, 2), np.int64), *pairs]), axis=0)
    return found[:, 0], found[:, 1]

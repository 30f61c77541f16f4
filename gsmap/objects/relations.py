"""Derive spatial relations between objects: on, in and next to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from gsmap.types import MapObject

_ON_M = 0.12  # largest gap between an object and the object below, as boxes enclose only the centres of Gaussians
_OVER = 0.5  # smallest fraction of its footprint over the object below
_INSIDE = 0.8  # smallest fraction of an object's box inside the object that contains it
_NEXT_M = 0.3  # largest distance in plan of objects next to each other

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
    for i, one in enumerate(objects):
        low, high = np.maximum(boxes[:, 0], boxes[i, 0]), np.minimum(boxes[:, 1], boxes[i, 1])
        overlap = np.clip(high - low, 0, None)
        inside, footprint = overlap.prod(1) / size[i].prod(), overlap[:, :2].prod(1)
        over = footprint / size[i, :2].prod()
        apart = footprint < _OVER * np.minimum(size[:, :2].prod(1), size[i, :2].prod())
        gap = np.linalg.norm(np.clip(low - high, 0, None)[:, :2], axis=1)
        for j in np.flatnonzero(gap < _NEXT_M).tolist():  # farther objects are not related
            other = objects[j]
            if i == j or one.component != other.component or one.there != other.there:
                continue
            if inside[j] >= _INSIDE and size[j].prod() > size[i].prod():
                out.append(Relation(one.id, "in", other.id))
            elif over[j] >= _OVER and abs(boxes[i, 0, 2] - boxes[j, 1, 2]) < _ON_M:
                out.append(Relation(one.id, "on", other.id))
            elif i < j and gap[j] < _NEXT_M and overlap[j, 2] > 0 and apart[j]:
                out.append(Relation(one.id, "next to", other.id))
    return out

"""Objects of the map, their sightings and relations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from gsmap.types.rows.base import Row


@dataclass(frozen=True, eq=False, kw_only=True)
class ObjectRow(Row):
    """One thing of the map, over all captures that show it.

    Args:
        id: what it is called (``o12``), also after objects were made again; 8 hex digits while it has no number, in a
            map that is open for reading only.
        name: what people call it; null where they do not.
        label: what kind of thing they say it is.
        note: the last one on it.
        room: id of the room that it stands in; null where that is not known.
        split_from: id of the object that it was one with until their component came apart; else null.
        component: of the map, whose frame everything is in.
        position: mean of its Gaussians, where it was last seen as a thing of its own.
        size: of the box around it where it was last seen, along the map's axes.
        colour: median colour, CIE L*a*b*.
        seen: captures that show it.
        looks: captures that show it, or that looked where it stood and do not.
        there: whether the newest of these shows it.
        first_seen: date of the oldest capture that shows it, ISO 8601; null where that has none.
        last_seen: of the newest.
        half_life_days: after which half of such objects are gone, by how long this one was watched; null where too few
            looks have dates.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "id": "object",
        "name": "name",
        "label": "label",
        "room": "room",
        "component": "component",
        "position": "position (map units)",
        "size": "size (map units)",
        "seen": "seen",
        "looks": "of looks",
        "there": "there",
        "first_seen": "first seen",
        "last_seen": "last seen",
        "half_life_days": "half-life (days)",
    }

    id: str
    component: int
    position: np.ndarray
    size: np.ndarray
    colour: np.ndarray
    seen: int
    looks: int
    there: bool
    first_seen: str | None
    last_seen: str | None
    half_life_days: float | None
    name: str | None = None
    label: str | None = None
    note: str | None = None
    room: str | None = None
    split_from: str | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class RelationRow(Row):
    """How one object stands to another; both are there still, or neither is.

    Args:
        subject: id of an object.
        relation: ``on``, ``in`` or ``next to``; the last holds both ways and is given once.
        other: id of the object that it stands to so.
    """

    columns: ClassVar[Mapping[str, str]] = {"subject": "object", "relation": "is", "other": "object"}

    subject: str
    relation: str
    other: str


@dataclass(frozen=True, eq=False, kw_only=True)
class RoomRow(Row):
    """A room of the map, as its captures show it.

    Args:
        id: ``r1`` is the largest of the first component; another capture may change it.
        component: of the map.
        position: the middle of its floor, map frame and unit.
        outline: (K, 2, 3) the ends of the straight pieces of line around its floor, map frame and unit, in no order.
        size_m: of the box around it, metres; the last number is its height.
        area_m2: of its floor.
        doors: ids of the rooms that one can walk to from it.
        objects: ids of the objects in it, those that are gone included.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "id": "room",
        "component": "component",
        "position": "position (map units)",
        "size_m": "size (m)",
        "area_m2": "m2",
        "doors": "doors to",
        "objects": "objects",
    }

    id: str
    component: int
    position: np.ndarray
    outline: np.ndarray
    size_m: np.ndarray
    area_m2: float
    doors: tuple[str, ...]
    objects: tuple[str, ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class ObjectsReport(Row):
    """The scene graph of the map.

    Args:
        objects: its nodes; of each component the largest first.
        relations: its edges.
        rooms: where its nodes stand.
        notes: what a person should know, such as captures that tell nothing.
    """

    columns: ClassVar[Mapping[str, str]] = {"objects": "objects", "relations": "relations"}

    objects: tuple[ObjectRow, ...]
    relations: tuple[RelationRow, ...]
    rooms: tuple[RoomRow, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class SightingRow(Row):
    """What one capture says of one object.

    Args:
        object: id of it.
        scene: id of the capture; of a photograph that the map keeps, its digest.
        scene_name: of it; of a photograph, its file.
        captured_at: when it was captured, ISO 8601; null where nobody knows.
        state: ``seen``; ``absent`` (the capture looked at or through its place, and it is not there); ``unseen`` (the
            capture did not look there, which says nothing).
        box: lowest and highest corner around it, map frame and unit; null where it was not seen.
        box_m: the same in metres.
        looked: share of its place that the capture looked at.
        component: index of the component whose frame the box is in.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "object": "object",
        "captured_at": "captured",
        "scene_name": "scene",
        "state": "state",
        "component": "component",
        "box_m": "box (m)",
        "looked": "looked at",
    }

    object: str
    scene: str
    scene_name: str
    captured_at: str | None
    state: str
    box: np.ndarray | None
    box_m: np.ndarray | None
    looked: float
    component: int


@dataclass(frozen=True, eq=False, kw_only=True)
class ObjectFactRow(Row):
    """One thing that was said of an object.

    Args:
        object: id of it.
        at: when it was said, ISO 8601.
        fact: ``name``, ``label``, ``note`` or ``same_as``.
        value: the text; empty where what was said before was taken back.
        author: who said it; empty where a person did and was not named.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "object": "object",
        "at": "said at",
        "fact": "fact",
        "value": "value",
        "author": "by",
    }

    object: str
    at: str
    fact: str
    value: str
    author: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class HistoryReport(Row):
    """What stood at a place, and when.

    Args:
        objects: what was ever seen there.
        sightings: what each capture says of each of them, oldest first.
        words: what people said of each of them, oldest first.
        notes: what a person should know, such as captures that tell nothing.
    """

    columns: ClassVar[Mapping[str, str]] = {"objects": "objects", "sightings": "sightings"}

    objects: tuple[ObjectRow, ...]
    sightings: tuple[SightingRow, ...]
    words: tuple[ObjectFactRow, ...] = ()
    notes: tuple[str, ...] = ()

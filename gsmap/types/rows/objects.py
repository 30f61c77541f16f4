"""Objects of the map, their observations and relations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from gsmap.types.rows.base import Row
from gsmap.types.rows.scenes import FactRow, SceneRef


@dataclass(frozen=True, eq=False, kw_only=True)
class ObjectRow(Row):
    """An object of the map, over all captures.

    Args:
        id: lasting id (``o12``); 8 hex digits without a number, in a map opened read-only.
        name: name; null if it has none.
        label: class label; null if it has none.
        note: newest note; null if there is none.
        room: id of its room; null if unknown.
        split_from: id of the object from which it was split when its component fell apart; else null.
        component: component of the map, frame of positions.
        position: mean of its Gaussians where it was last segmented.
        size: size of its bounding box along the map's axes where it was last seen.
        colour: median colour, CIE L*a*b*.
        seen: number of captures that show it.
        looks: number of captures that show it or show that it is absent.
        there: true if the newest of these shows it.
        first_seen: date of the oldest capture that shows it, ISO 8601; null if undated.
        last_seen: date of the newest capture that shows it, ISO 8601; null if undated.
        half_life_days: estimated time in days after which half of such objects are gone; null if too few observations
            have dates.
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
    """A relation of two objects that are both present or both gone.

    Args:
        subject: id of the first object.
        relation: ``on``, ``in`` or ``next to``; the last is symmetric and listed once.
        other: id of the second object.
    """

    columns: ClassVar[Mapping[str, str]] = {"subject": "object", "relation": "is", "other": "object"}

    subject: str
    relation: str
    other: str


@dataclass(frozen=True, eq=False, kw_only=True)
class RoomRow(Row):
    """A room of the map.

    Args:
        id: ``r1`` is the largest room of the first component; ids may change with new captures.
        component: component of the map.
        position: centre of its floor, map frame and unit.
        outline: (K, 2, 3) end points of the unordered line segments around its floor, map frame and unit.
        size_m: size of its bounding box in metres; the last number is its height.
        area_m2: floor area in square metres.
        doors: ids of the rooms connected by doors.
        objects: ids of its present and former objects.
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
    """The objects of the map as a graph.

    Args:
        objects: objects, the largest of each component first.
        relations: relations.
        rooms: rooms.
        notes: remarks, such as captures without segments.
    """

    columns: ClassVar[Mapping[str, str]] = {"objects": "objects", "relations": "relations"}

    objects: tuple[ObjectRow, ...]
    relations: tuple[RelationRow, ...]
    rooms: tuple[RoomRow, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class ObjectObservationRow(SceneRef):
    """The observation of an object by one capture.

    Args:
        object: object id.
        scene: capture id, or the digest of a stored photo.
        scene_name: capture name, or the file of a stored photo.
        captured_at: capture date, ISO 8601; null if unknown.
        state: ``seen``; ``absent`` (the capture observed its place, and it is not there); ``unseen`` (its place was not
            observed).
        box: lowest and highest corner, map frame and unit; null if it was not seen.
        box_m: the box in metres; null if it was not seen.
        looked: fraction of its place that the capture observed.
        component: component of the box.
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
    captured_at: str | None
    state: str
    box: np.ndarray | None
    box_m: np.ndarray | None
    looked: float
    component: int


@dataclass(frozen=True, eq=False, kw_only=True)
class ObjectFactRow(FactRow):
    """An annotation of an object.

    Args:
        object: object id.
        fact: ``name``, ``label``, ``note`` or ``same_as``.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "object": "object",
        "at": "said at",
        "fact": "fact",
        "value": "value",
        "author": "by",
    }

    object: str


@dataclass(frozen=True, eq=False, kw_only=True)
class HistoryReport(Row):
    """The objects of a place over time.

    Args:
        objects: objects ever seen there.
        sightings: observations of each object, oldest first.
        words: annotations of each object, oldest first.
        notes: remarks, such as captures without segments.
    """

    columns: ClassVar[Mapping[str, str]] = {"objects": "objects", "sightings": "sightings"}

    objects: tuple[ObjectRow, ...]
    sightings: tuple[ObjectObservationRow, ...]
    words: tuple[ObjectFactRow, ...] = ()
    notes: tuple[str, ...] = ()

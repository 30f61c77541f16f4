"""Compute the objects of a map from scene graphs, report them as rows, and export them."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.durable import write_text_output
from gsmap.errors import ConfigError, DiskFullError, InputError, NotFoundError, ReadOnlyError
from gsmap.geometry.directions import level_frame
from gsmap.map.date_filter import capture_time
from gsmap.map.objects.annotations import apply_annotations, why_distinct
from gsmap.map.objects.associate import ComponentObjects, objects_of_components
from gsmap.map.objects.photo_observations import add_photo_observations
from gsmap.map.settings import Settings
from gsmap.objects import estimate_persistence, graphml, object_graph, relations
from gsmap.store import Store
from gsmap.store.facts import Fact
from gsmap.store.objects import ComputedObjects, number_of
from gsmap.texts import few
from gsmap.types import MapObject, ObjectAnnotations, ObjectObservation, Room, Scene, SceneGraph
from gsmap.types.progress import StageProgress
from gsmap.types.rows.base import SCHEMA
from gsmap.types.rows.objects import (
    HistoryReport,
    ObjectFactRow,
    ObjectObservationRow,
    ObjectRow,
    ObjectsReport,
    RelationRow,
    RoomRow,
)

FORMATS = ("json", "graphml")

_HEX = re.compile(r"[0-9a-f]{4,8}")
_POINT = re.compile(r"[-+0-9.eE,\s]+")
_NEAR_M = 0.1  # a point so near to a box is in it: it was read off a picture


@dataclass(frozen=True, eq=False)
class MapObjects:
    """The objects of a map with the scenes, rooms and annotations needed to report them.

    Args:
        objects: the objects of all components, without parts of the building that nobody annotated.
        scenes: the placed scenes by id.
        notes: scenes without objects, with the reason.
        metres: metres per map unit, by component.
        photos: (file, date, time at which it was added) of the stored photos, by digest.
        joined: id of the object into which each joined object was merged.
        facts: all annotations, by object id.
        rooms: rotation (3, 3) from the component's frame to a level one, and the rooms in that frame in metres.
        parted: id of the object from which each was split when its component fell apart.
        building: segments that are rather parts of the building than objects; they have numbers, too.
        segmented: scenes with segments of each component, oldest first.
    """

    objects: list[MapObject]
    scenes: dict[str, Scene]
    notes: tuple[str, ...]
    metres: dict[int, float]
    photos: Mapping[str, tuple[str, str | None, str]] = field(default_factory=dict)
    joined: Mapping[str, str] = field(default_factory=dict)
    facts: Mapping[str, Sequence[Fact]] = field(default_factory=dict)
    rooms: Mapping[int, tuple[np.ndarray, tuple[Room, ...]]] = field(default_factory=dict)
    parted: Mapping[str, str] = field(default_factory=dict)
    building: Sequence[MapObject] = ()
    segmented: Mapping[int, Sequence[str]] = field(default_factory=dict)

    @cached_property
    def dates(self) -> dict[str, str | None]:
        """Dates of scenes and photos, by id."""
        of_photos = {photo: when for photo, (_, when, _) in self.photos.items()}
        return {scene.id: scene.captured_at for scene in self.scenes.values()} | of_photos

    def name_of(self, who: str) -> str:
        """Return the name of a scene or photo."""
        return self.scenes[who].name if who in self.scenes else self.photos[who][0]

    def all_sightings(self, thing: MapObject) -> list[ObjectObservation]:
        """Return the observations of an object by the segmented scenes of its component and by photos, oldest first."""
        known = {one.scene: one for one in thing.sightings}
        scenes = self.segmented.get(thing.component, ())
        every = [known.pop(scene, ObjectObservation(scene, "unseen", -1, None, 0.0)) for scene in scenes]
        if not known:
            return every
        times = {one.id: capture_time(one.captured_at, one.ingested_at) for one in self.scenes.values()}
        times |= {photo: capture_time(when, came) for photo, (_, when, came) in self.photos.items()}
        return sorted([*every, *known.values()], key=lambda one: times[one.scene])

    @cached_property
    def rooms_of(self) -> dict[str, str]:
        """Room id of each object with a known room, by object id."""
        out: dict[str, str] = {}
        for component in self.rooms:
            mine = [thing for thing in self.objects if thing.component == component]
            rooms = self.rooms_at(component, np.array([thing.position for thing in mine]).reshape(-1, 3))
            out |= {thing.id: room for thing, room in zip(mine, rooms, strict=True) if room is not None}
        return out

    def rooms_at(self, component: int, positions: np.ndarray) -> list[str | None]:
        """Return the id of the room at each position (N, 3) of a component's frame; None outside of rooms."""
        level, rooms = self.rooms[component]
        places = positions @ level.T * self.metres[component]
        out: list[str | None] = [None] * len(places)
        for i in reversed(range(len(rooms))):  # a position in two rooms belongs to the larger
            low, high = rooms[i].box
            near = ((places[:, :2] >= low[:2]) & (places[:, :2] <= high[:2])).all(1)
            for k in np.flatnonzero(near):
                if rooms[i].holds(places[k]):
                    out[k] = self._room_id(component, i)
        return out

    def room_of_box(self, component: int, box: np.ndarray) -> str | None:
        """Return the id of the room that holds most of a box (2, 3) of a component's frame; None outside of rooms."""
        if component not in self.rooms:
            return None
        sides = np.linspace(box[0], box[1], 7)[1:-1].T
        found = self.rooms_at(component, np.stack(np.meshgrid(*sides), -1).reshape(-1, 3))
        known = [room for room in found if room is not None]
        return max(dict.fromkeys(known), key=known.count) if known else None

    @cached_property
    def _first_rooms(self) -> dict[int, int]:
        """Number of rooms of the components before each component."""
        counts = [len(self.rooms[component][1]) for component in sorted(self.rooms)]
        return dict(zip(sorted(self.rooms), np.cumsum([0, *counts])[:-1].tolist(), strict=True))

    def _room_id(self, component: int, number: int) -> str:
        return f"r{self._first_rooms[component] + number + 1}"

    def room_rows(self) -> tuple[RoomRow, ...]:
        """Return the rooms of all components, the largest of each component first."""
        rows = []
        objects: dict[str, list[str]] = {}
        for thing in self.objects:
            if thing.id in self.rooms_of:
                objects.setdefault(self.rooms_of[thing.id], []).append(thing.id)
        for component, (level, mine) in sorted(self.rooms.items()):
            unit = self.metres[component]
            for i, room in enumerate(mine):
                name = self._room_id(component, i)
                rows.append(
                    RoomRow(
                        id=name,
                        component=component,
                        position=level.T @ room.middle / unit,
                        outline=room.outline @ level / unit,
                        size_m=room.box[1] - room.box[0],
                        area_m2=round(room.area_m2, 2),
                        doors=tuple(self._room_id(component, other) for other in room.doors),
                        objects=tuple(objects.get(name, ())),
                    )
                )
        return tuple(rows)

    def named(self, text: str) -> MapObject:
        """Return an object by its id (``o12``), the id of an object joined to it, or its name.

        Raises:
            NotFoundError: none, or several.
        """
        ids = {self.joined.get(text, text)}
        found = [one for one in self.objects if one.id in ids]
        found = found or [one for one in self.objects if one.words.name.casefold() == text.casefold()]
        if not found and _HEX.fullmatch(text):
            found = [one for one in self.objects if one.id.startswith(text)]
        if not found and ids & {one.id for one in self.building}:
            raise NotFoundError(
                f"{text} is a wall, a room or another part of the building, not an object", code="object_not_found"
            )
        if len(found) != 1:
            why = (
                f"{', '.join(one.id for one in found)} all have this name"
                if found
                else "no object of the map has this name"
            )
            raise NotFoundError(f"{text}: {why}; gsmap graph MAP lists them", code="object_not_found")
        return found[0]


def compute_objects(
    store: Store,
    settings: Settings,
    progress: StageProgress,
    graphs: Mapping[str, SceneGraph] | None = None,
    *,
    make: bool = True,
) -> MapObjects:
    """Return the objects of every component by the newest poses, with annotations and photo observations.

    They are made where what is kept of them is out of date, and then kept, unless the map is open for reading only.

    Args:
        graphs: by scene, what the captures are taken to show; no capture is then asked whether it looked where others
            show something, and nothing is kept. By default the newest graph of each, and all are asked.
        make: compute objects that are out of date.

    Raises:
        NotFoundError: the map has no poses yet, or what is kept is out of date and is not to be made.
    """
    placed, scenes, metres, parts, notes = objects_of_components(store, settings, progress, graphs, make=make)
    objects = _numbered(store, parts)
    components = {scene: pose.component for scene, pose in placed.poses.items()}
    known = {number: one.component for one in objects if (number := number_of(one.id))}
    parted = {f"o{number}": f"o{other}" for number, other in store.objects.split_objects(known, components).items()}
    if parted:
        told = few([f"{one} from {other}" for one, other in parted.items()])
        notes = [*notes, f"components came apart, and objects with them: {told} were split"]
    rooms = {part.component: (level_frame(part.made.up), part.made.rooms) for part in parts}
    objects, joined, said = apply_annotations(store, objects, scenes)
    kept = store.photos.list() if graphs is None else []
    if kept:
        at = {scene: pose.S_map_scene for scene, pose in placed.poses.items()}
        objects = add_photo_observations(objects, kept, scenes, at, metres, components)
    progress("objects", 1.0, f"{len(objects)} objects")
    photos = {one.sighting.digest: (one.sighting.name, one.sighting.captured_at, one.created_at) for one in kept}
    building = [one for one in objects if one.is_building and one.words == ObjectAnnotations()]
    left_out = {one.id for one in building}
    return MapObjects(
        [one for one in objects if one.id not in left_out],
        scenes,
        (*notes, *(said if graphs is None else ())),
        metres,
        photos,
        joined,
        store.objects.facts(),
        rooms,
        parted,
        building,
        {part.component: [scene for scene, things in part.made.things.items() if things] for part in parts},
    )


def _numbered(store: Store, parts: Sequence[ComponentObjects]) -> list[MapObject]:
    """Assign numbers to the objects of all components, and store new objects if the map is writable."""
    new = [part for part in parts if part.places is not None]
    made: dict[int, Sequence[MapObject]] = {
        part.component: [replace(thing, component=part.component) for thing in part.made.objects] for part in parts
    }
    saved = None
    if store.catalog.writable and all(part.key is not None for part in new):
        computed = [ComputedObjects(part.made, part.places or (), part.key) for part in new if part.key is not None]
        with suppress(DiskFullError, ReadOnlyError):
            saved = store.objects.save(computed) if computed else []
    if saved is not None:
        made |= {part.component: kept.objects for part, kept in zip(new, saved, strict=True)}
    elif new:
        found = [places for part in new for places in part.places or () if places is not None]
        kept = {number for part in parts for thing in part.made.objects if (number := number_of(thing.id)) is not None}
        numbers = iter(store.objects.match_numbers(found, kept))
        for part in new:
            made[part.component] = [
                thing if places is None or (number := next(numbers)) is None else replace(thing, id=f"o{number}")
                for thing, places in zip(part.made.objects, part.places or (), strict=True)
            ]
    return [thing for part in parts for thing in made[part.component]]


def load_objects(store: Store, settings: Settings) -> MapObjects:
    """Load the stored objects of a map from the catalog.

    Raises:
        NotFoundError: they are out of date.
    """
    return compute_objects(store, settings, lambda *_: None, make=False)


# --- what people say ------------------------------------------------------------------------------------------------


def edit_object(
    store: Store,
    settings: Settings,
    ref: str,
    progress: StageProgress,
    *,
    name: str | None = None,
    label: str | None = None,
    note: str | None = None,
    same_as: str | None = None,
    author: str = "",
) -> ObjectRow:
    """Annotate an object and return its row.

    Args:
        ref: its id or name.
        name, label, same_as: ``none`` takes back what was said before.

    Raises:
        NotFoundError: no such object.
        InputError: a name that is taken, two that one capture shows apart; nothing is written.
    """
    known = compute_objects(store, settings, progress)
    if name is not None and _none(name):
        name = ""
    thing = next((one for one in known.objects if one.id == ref), None)
    number = number_of(ref) if ref in known.joined or thing is not None else None
    if number is None:
        number = number_of(known.named(ref).id)
    if number is None:
        raise NotFoundError(f"{ref} has no number yet: the map is open read-only", code="object_without_number")
    other = None if same_as is None else 0
    if same_as is not None and not _none(same_as):
        target, mine = known.named(same_as), known.named(f"o{number}")
        other = number_of(target.id)
        if why := why_distinct(mine, target, known.scenes):
            raise InputError(f"o{number} and {target.id} cannot be the same object: {why}", code="objects_differ")
    store.objects.edit(
        number,
        name=name,
        label="" if label is not None and _none(label) else label,
        note=note,
        same_as=other,
        author=author,
    )
    known = compute_objects(store, settings, progress)
    return object_row(known.named(f"o{number}"), known)


def _none(text: str) -> bool:
    return text.strip().lower() == "none"


# --- rows ------------------------------------------------------------------------------------------------------------


def objects_report(known: MapObjects) -> ObjectsReport:
    """Report the objects, relations and rooms of a map."""
    return ObjectsReport(
        objects=tuple(object_row(thing, known) for thing in known.objects),
        relations=tuple(
            RelationRow(subject=one.source, relation=one.kind, other=one.target)
            for one in relations(known.objects, known.metres)
        ),
        rooms=known.room_rows(),
        notes=known.notes,
    )


def history_report(known: MapObjects, place: str | None, box: Sequence[float] | None) -> HistoryReport:
    """Report the history of a place: an object (id or name), a point ``X,Y,Z``, or a box of six numbers.

    Raises:
        ConfigError: neither, both, or not what these look like.
        NotFoundError: no object is called so.
    """
    if (place is None) == (box is None):
        raise ConfigError(
            "specify one place: the id of an object, a point X,Y,Z, or --box with six numbers", code="nothing_requested"
        )
    if place is not None and not ("," in place and _POINT.fullmatch(place)):
        chosen = [known.named(place)]
    else:
        area = _area(place, box)
        chosen = [
            thing
            for thing in known.objects
            if any(_meets(s.box, area, _NEAR_M / known.metres[thing.component]) for s in thing.sightings)
        ]
    rows = [
        ObjectObservationRow(
            object=thing.id,
            scene=sighting.scene,
            scene_name=known.name_of(sighting.scene),
            captured_at=known.dates[sighting.scene],
            state=sighting.state,
            box=sighting.box,
            box_m=None if sighting.box is None else sighting.box * known.metres[thing.component],
            looked=sighting.looked,
            component=thing.component,
        )
        for thing in chosen
        for sighting in known.all_sightings(thing)
    ]
    notes = known.notes if chosen else (*known.notes, "no object was ever found there")
    words = [
        ObjectFactRow(object=thing.id, at=fact.created_at, fact=fact.kind, value=fact.value, author=fact.author)
        for thing in chosen
        for one in (thing.id, *(other for other, to in known.joined.items() if to == thing.id))
        for fact in known.facts.get(one, ())
    ]
    return HistoryReport(
        objects=tuple(object_row(thing, known) for thing in chosen),
        sightings=tuple(rows),
        words=tuple(words),
        notes=notes,
    )


def _area(place: str | None, box: Sequence[float] | None) -> np.ndarray:
    """Return the corners (2, 3) of a point or a box."""
    try:
        numbers = (
            [float(part) for part in place.split(",")] if place is not None else np.ravel(np.array(box, float)).tolist()
        )
    except ValueError as error:
        raise ConfigError(
            f"a point needs three numbers such as 1.5,0,2, got {place!r}", code="invalid_point"
        ) from error
    if len(numbers) != (3 if place is not None else 6) or not np.isfinite(numbers).all():
        raise ConfigError(
            "a point needs X,Y,Z; a box needs six numbers, its lowest and its highest corner", code="invalid_point"
        )
    corners = np.array(numbers).reshape(-1, 3)
    if (corners[0] > corners[-1]).any():
        raise ConfigError("the lowest corner of a box must come before its highest corner", code="invalid_box")
    return np.array([corners[0], corners[-1]])


def _meets(box: np.ndarray | None, area: np.ndarray, near: float) -> bool:
    return box is not None and bool((box[0] <= area[1] + near).all() and (box[1] >= area[0] - near).all())


def object_row(thing: MapObject, known: MapObjects) -> ObjectRow:
    """Return the row of an object."""
    stays = estimate_persistence(thing, known.dates)
    seen = [known.dates[sighting.scene] for sighting in thing.sightings if sighting.state == "seen"]
    return ObjectRow(
        id=thing.id,
        component=thing.component,
        position=thing.position,
        size=thing.box[1] - thing.box[0],
        colour=thing.colour.astype(np.float64),
        seen=stays.seen,
        looks=stays.looks,
        there=thing.there,
        first_seen=seen[0],
        last_seen=seen[-1],
        half_life_days=stays.half_life_days,
        name=thing.words.name or None,
        label=thing.words.label or None,
        note=thing.words.note or None,
        room=known.rooms_of.get(thing.id),
        split_from=known.parted.get(thing.id),
    )


# --- other programs --------------------------------------------------------------------------------------------------


def as_networkx(known: MapObjects) -> Any:
    """Return a `networkx.MultiDiGraph`, see `gsmap.objects.object_graph`."""
    return object_graph(known.objects, known.dates, known.metres, known.room_rows())


def write_graph(known: MapObjects, out: str | os.PathLike[str], format: str, map_id: str) -> Path:
    """Write the objects of the map as a graph; after an error, no partial file remains.

    Raises:
        ConfigError: another format than ``json`` (what ``--json`` prints) and ``graphml``.
    """
    if format not in FORMATS:
        raise ConfigError(
            f"the format of the graph must be {' or '.join(FORMATS)}, got {format!r}", code="invalid_choice"
        )
    path = Path(out)
    if format == "json":
        write_text_output(path, json.dumps({"schema": SCHEMA, **objects_report(known).to_json()}, indent=1), map_id)
        return path
    write_text_output(path, graphml(as_networkx(known)), map_id)
    return path

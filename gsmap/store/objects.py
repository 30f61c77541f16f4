"""Objects of the map: their numbers, their annotations, and the object sets computed for each component.

An object keeps its number and facts when objects are computed again: it is recognized by its boxes in the captures' own
frames, so that neither poses nor the order of captures matter. A new result replaces the previous one.
"""

from __future__ import annotations

import base64
import re
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from sqlalchemy import Connection, Row, delete, func, insert, select, update

from gsmap.errors import InputError, NotFoundError
from gsmap.geometry.boxes import box_overlaps
from gsmap.methods import RecipeKey
from gsmap.store import facts, recipes
from gsmap.store.catalog import Catalog, now
from gsmap.store.column_types import is_object_set, malformed_as_corrupt
from gsmap.store.facts import Fact
from gsmap.store.matrices import from_array, from_pose, to_pose
from gsmap.store.result_rows import ResultRows
from gsmap.store.schema import object_facts, object_places, objects
from gsmap.types import MapObject, ObjectAnnotations, ObjectObservation, Room, Sim3
from gsmap.types.map_object import OBSERVATION_STATES
from gsmap.types.plain import plain

ObjectBoxes = Mapping[str, np.ndarray]
"""Boxes (2, 3) of an object in the scene frame, by scene id."""

SETS = ResultRows("objects", is_object_set, required=("scenes",))

# Minimum intersection over union of the boxes of one object in two computations, each padded by a fraction of the
# larger one's diagonal because the box of a picture on a wall has almost no thickness.
_MIN_OVERLAP = 0.1
_PAD = 0.03

_MAX_CELLS = 1 << 24  # cells of a room, hundreds of metres wide

_NUMBER = re.compile(r"o([1-9][0-9]{0,8})")
_RESERVED_NAME = re.compile(r"o[0-9]+|[0-9a-f]{8}|[-+0-9.eE,\s]+")  # reserved for ids and points


@dataclass(frozen=True, eq=False)
class ObjectSet:
    """The objects computed for one component.

    Args:
        key: `RecipeKey.digest` of the recipe and inputs.
        recipe: `RecipeKey.recipe`.
        metres: per unit of the map.
        poses: ``S_map_scene`` of its captures by scene id, as used for it.
        things: digest of the segments of each capture, by scene id.
        objects: with numbers as ids, without photographs and facts, in the frame of ``poses``.
        up: (3,) direction against gravity in that frame.
        rooms: in the level frame of ``up`` (`gsmap.geometry.directions.level_frame`), the largest first.
        graphs: key of the graph of each capture, by scene id.
        boxes: box (2, 3) around the segments of each capture that has some, in the frame of ``poses``.
        views: box (2, 3) around what the cameras of a capture can observe, in the same frame, by scene id.
        surfaces: box (2, 3) of the surface points of each capture from which rooms are found, level frame in metres.
        told: what comparisons said of the segments, by ``OLDER:NEWER``.
    """

    key: str
    recipe: str
    metres: float
    poses: dict[str, Sim3]
    things: dict[str, str]
    objects: tuple[MapObject, ...]
    up: np.ndarray = field(default_factory=lambda: np.array([0.0, 0, 1]))
    rooms: tuple[Room, ...] = ()
    graphs: Mapping[str, str] = field(default_factory=dict)
    boxes: Mapping[str, np.ndarray] = field(default_factory=dict)
    views: Mapping[str, np.ndarray] = field(default_factory=dict)
    surfaces: Mapping[str, np.ndarray] = field(default_factory=dict)
    told: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class ComputedObjects:
    """The objects computed for one component, to be stored.

    Args:
        made: the objects; ids that are no numbers are replaced by numbers.
        places: boxes by scene of each object; None for an object that keeps its number.
        key: recipe and inputs.
    """

    made: ObjectSet
    places: Sequence[ObjectBoxes | None]
    key: RecipeKey


def number_of(text: str) -> int | None:
    """Parse the number of an object from its id (``o12``); None for other texts."""
    found = _NUMBER.fullmatch(text)
    return None if found is None else int(found[1])


class Objects:
    """The objects of a map."""

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog

    # --- object sets -------------------------------------------------------------------------------------------------

    def sets(self) -> list[ObjectSet]:
        """Return the newest object set of every component.

        Raises:
            CorruptError: the catalog holds an invalid object set.
        """
        with self._catalog.read() as connection:
            rows = connection.execute(SETS.select().order_by(SETS.c.number)).all()
        return [_read(row) for row in rows]

    def save(self, parts: Sequence[ComputedObjects]) -> list[ObjectSet]:
        """Store object sets in place of stored sets that share a capture with them.

        No number is assigned twice in the map. If a component was split, an object keeps its number in the part where
        more captures show it; the other part gets a new object, see `split_objects`.

        Returns:
            The object sets with numbers as ids.
        """
        with self._catalog.write() as connection:
            forget_sets(connection, [scene for part in parts for scene in part.made.poses])
            kept = [
                number
                for part in parts
                for thing, places in zip(part.made.objects, part.places, strict=True)
                if places is None and (number := number_of(thing.id)) is not None
            ]
            given = _numbers_in_use(connection).union(kept)
            found = [places for part in parts for places in part.places if places is not None]
            when = now()
            made: list[int] = []
            for number in match_objects(connection, found, given):
                if number is None:
                    new = connection.execute(insert(objects).returning(objects.c.number), {"created_at": when})
                    number = int(new.scalar_one())
                made.append(number)
            rest = iter(made)
            return [self._save(connection, part, rest, given.union(made), when) for part in parts]

    def _save(
        self, connection: Connection, part: ComputedObjects, numbers: Iterator[int], given: Collection[int], when: str
    ) -> ObjectSet:
        """Store one object set.

        Args:
            numbers: of its new objects, and of further ones.
            given: numbers of all objects of the map.
        """
        made = part.made
        own = [
            thing if places is None else replace(thing, id=f"o{next(numbers)}")
            for thing, places in zip(made.objects, part.places, strict=True)
        ]
        kept = replace(made, objects=tuple(own))
        new = {
            number: places
            for thing, places in zip(own, part.places, strict=True)
            if places is not None and (number := number_of(thing.id)) is not None
        }
        mine = {number_of(thing.id) for thing in own}
        self._update_split_objects(connection, part, [number for number in given if number not in mine])
        _replace_places(connection, new, made.poses)
        SETS.insert(
            connection,
            key=part.key.digest,
            recipe=recipes.save_recipe(connection, part.key),
            scenes=" ".join(made.poses),
            num_items=len(kept.objects),
            about={"poses": {scene: from_pose(pose) for scene, pose in made.poses.items()}, **_value(kept)},
            created_at=when,
        )
        return kept

    def _update_split_objects(self, connection: Connection, part: ComputedObjects, others: Collection[int]) -> None:
        """Update the boxes of objects in other components that a split of a component separated from objects of this
        set.

        Their boxes then stay equal, so that each keeps its number, and they merge again when the components do.
        """
        new = [places for places in part.places if places is not None]
        wanted = set(others)
        for row in _place_rows(connection, {scene for places in new for scene in places}) if wanted else ():
            if row.object in wanted:
                here = np.array([places[row.scene] for places in new if row.scene in places])
                share = _overlaps(here, np.array([row.box], np.float64)).ravel() if len(here) else np.zeros(1)
                if share.max() >= _MIN_OVERLAP:
                    same = (object_places.c.object == row.object) & (object_places.c.scene == row.scene)
                    box = from_array(here[share.argmax()])
                    connection.execute(update(object_places).where(same).values(box=box))

    def match_numbers(self, places: Sequence[ObjectBoxes], taken: Collection[int] = ()) -> list[int | None]:
        """Find the numbers of objects by their boxes, without storing anything; None for unknown objects.

        Args:
            taken: numbers of objects that keep theirs.
        """
        captures = {scene for one in places for scene in one}
        with self._catalog.read() as connection:
            return match_objects(connection, places, _numbers_in_use(connection, besides=captures).union(taken))

    def split_objects(self, components: Mapping[int, int], scenes: Mapping[str, int]) -> dict[int, int]:
        """Return pairs of objects that were one before their component was split, as a mapping between their numbers.

        Args:
            components: component of each object, by number.
            scenes: component of each placed scene.
        """
        with self._catalog.read() as connection:
            rows = connection.execute(select(object_places).order_by(object_places.c.object)).all()
        by_scene: dict[str, tuple[list[Row[Any]], list[Row[Any]]]] = {}
        for row in rows:
            component = components.get(row.object)
            if component is not None:
                by_scene.setdefault(row.scene, ([], []))[scenes.get(row.scene) != component].append(row)
        out: dict[int, int] = {}
        for here, elsewhere in by_scene.values():
            if here and elsewhere:
                boxes = (np.array([row.box for row in some], np.float64) for some in (here, elsewhere))
                for i, j in np.argwhere(_overlaps(*boxes) >= _MIN_OVERLAP):
                    out.setdefault(here[i].object, elsewhere[j].object)
        return out

    # --- facts -------------------------------------------------------------------------------------------------------

    def edit(
        self,
        number: int,
        *,
        name: str | None = None,
        label: str | None = None,
        note: str | None = None,
        same_as: int | None = None,
        author: str = "",
    ) -> None:
        """Add facts about an object; earlier facts stay in `facts`.

        Args:
            name: unique among objects; empty to withdraw it.
            label: category of the object; empty to withdraw it.
            note: added to the existing notes.
            same_as: number of the object that it is identical with; 0 to withdraw that.
            author: of the facts.

        Raises:
            NotFoundError: no such object.
            InputError: an empty text, control characters, a name that is in use or looks like an id or a point, or a
                cycle of identical objects.
        """
        new: list[tuple[str, str]] = []
        if name is not None:
            new.append(("name", _validated_name(name) if name else ""))
        if label is not None:
            new.append(("label", facts.validated_text("a label", label).strip() if label else ""))
        if note is not None:
            new.append(("note", facts.validated_text("a note", note, lines=True)))
        if same_as is not None:
            new.append(("same_as", f"o{same_as}" if same_as else ""))
        if author:
            facts.validated_text("an author", author)
        with self._catalog.write() as connection:
            for one in (number, same_as or number):
                if connection.execute(select(objects.c.number).where(objects.c.number == one)).first() is None:
                    raise NotFoundError(
                        f"this map has no object o{one}: gsmap graph MAP lists them", code="object_not_found"
                    )
            annotations = current_annotations(connection)
            mine = annotations.get(number, ObjectAnnotations())
            new = [(kind, value) for kind, value in new if kind == "note" or getattr(mine, kind) != value]
            for kind, value in new:
                if kind == "name" and value:
                    _check_free(annotations, number, value)
                if kind == "same_as" and value:
                    _check_acyclic(annotations, number, value)
            rows = [
                {"object": number, "kind": kind, "value": value, "author": author, "created_at": now()}
                for kind, value in new
            ]
            if rows:
                connection.execute(insert(object_facts), rows)

    def annotations(self) -> dict[str, ObjectAnnotations]:
        """Return the current annotations of all annotated objects, by id (``o12``)."""
        with self._catalog.read() as connection:
            return {f"o{number}": words for number, words in current_annotations(connection).items()}

    def facts(self) -> dict[str, list[Fact]]:
        """Return all facts about objects by id (``o12``), oldest first."""
        out: dict[str, list[Fact]] = {}
        query = select(object_facts).order_by(object_facts.c.number)
        with self._catalog.read() as connection:
            for row in connection.execute(query):
                fact = Fact(row.kind, row.value, row.author, row.created_at)
                out.setdefault(f"o{row.object}", []).append(fact)
        return out

    def places(self, number: int) -> dict[str, np.ndarray]:
        """Return the boxes of an object by scene, as last computed."""
        query = select(object_places).where(object_places.c.object == number)
        with self._catalog.read() as connection:
            return {row.scene: np.array(row.box, np.float64) for row in connection.execute(query)}


# --- matching --------------------------------------------------------------------------------------------------------


def match_objects(
    connection: Connection, found: Sequence[ObjectBoxes], given: Collection[int] = ()
) -> list[int | None]:
    """Assign to each given object the number of a stored object, or None to a new object; no number is assigned twice.

    Pairs are matched by the number of captures with overlapping boxes; ties prefer the object all of whose boxes match,
    then the older one.

    Args:
        given: numbers of other objects, which are not assigned.
    """
    known: dict[str, list[tuple[int, np.ndarray]]] = {}
    for row in _place_rows(connection, {scene for places in found for scene in places}):
        known.setdefault(row.scene, []).append((row.object, np.array(row.box, np.float64)))
    counts = _num_places(connection, {number for places in known.values() for number, _ in places})
    score: dict[tuple[int, int], float] = {}
    by_scene: dict[str, list[tuple[int, np.ndarray]]] = {}
    for i, places in enumerate(found):
        for scene, box in places.items():
            by_scene.setdefault(scene, []).append((i, box))
    for scene, mine in by_scene.items():
        theirs = known.get(scene)
        if not theirs:
            continue
        share = _overlaps(np.array([box for _, box in mine]), np.array([box for _, box in theirs]))
        for a, b in np.argwhere(share >= _MIN_OVERLAP):
            pair = mine[a][0], theirs[b][0]
            score[pair] = score.get(pair, 0.0) + float(share[a, b])
    numbers: list[int | None] = [None] * len(found)
    taken = set(given)
    order = sorted((-round(value, 6), -value / counts[number], number, i) for (i, number), value in score.items())
    for _, _, number, i in order:
        if numbers[i] is None and number not in taken:
            numbers[i] = number
            taken.add(number)
    return numbers


_MAX_NAMED = 500  # values that one statement names; more of them read the whole table


def _place_rows(connection: Connection, scenes: Collection[str]) -> Sequence[Row[Any]]:
    """Return the boxes of objects in some scenes."""
    query = select(object_places).order_by(object_places.c.object, object_places.c.scene)
    if len(scenes) <= _MAX_NAMED:
        return connection.execute(query.where(object_places.c.scene.in_(sorted(scenes)))).all()
    return [row for row in connection.execute(query) if row.scene in scenes]


def _num_places(connection: Connection, numbers: Collection[int]) -> dict[int, int]:
    """Return the number of boxes of each of some objects."""
    query = select(object_places.c.object, func.count()).group_by(object_places.c.object)
    if len(numbers) <= _MAX_NAMED:
        query = query.where(object_places.c.object.in_(sorted(numbers)))
    return {row[0]: row[1] for row in connection.execute(query)}


def _replace_places(connection: Connection, places: Mapping[int, ObjectBoxes], scenes: Collection[str]) -> None:
    """Replace the boxes of objects in some scenes; boxes in other scenes stay."""
    numbers = sorted(places)
    for start in range(0, len(numbers), _MAX_NAMED):
        mine = object_places.c.object.in_(numbers[start : start + _MAX_NAMED])
        rows = connection.execute(select(object_places).where(mine)).all()
        connection.execute(delete(object_places).where(mine))
        stay = [{"object": row.object, "scene": row.scene, "box": row.box} for row in rows if row.scene not in scenes]
        new = [
            {"object": number, "scene": scene, "box": from_array(box)}
            for number in numbers[start : start + _MAX_NAMED]
            for scene, box in places[number].items()
        ]
        if stay + new:
            connection.execute(insert(object_places), stay + new)


def _numbers_in_use(connection: Connection, besides: Iterable[str] = ()) -> set[int]:
    """Return the numbers of objects in stored sets, without sets with any of the captures ``besides``."""
    out, others = set(), set(besides)
    for row in connection.execute(SETS.select()):
        if not others & set(row.about["poses"]):
            out |= {number for thing in _read(row).objects if (number := number_of(thing.id)) is not None}
    return out


def _overlaps(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Compute the intersection over union (N, M) of padded boxes (N, 2, 3) and (M, 2, 3)."""
    size = np.maximum(
        np.linalg.norm(a[:, 1] - a[:, 0], axis=1)[:, None], np.linalg.norm(b[:, 1] - b[:, 0], axis=1)[None]
    )
    return box_overlaps(a, b, np.maximum(_PAD * size, 1e-9)[..., None])


# --- facts -----------------------------------------------------------------------------------------------------------


def current_annotations(connection: Connection) -> dict[int, ObjectAnnotations]:
    """Return the current annotations of objects by number."""
    by_object: dict[int, dict[str, str]] = {}
    for row in connection.execute(select(object_facts).order_by(object_facts.c.number)):
        by_object.setdefault(row.object, {})[row.kind] = row.value
    return {number: ObjectAnnotations(**values) for number, values in by_object.items() if any(values.values())}


def _validated_name(name: str) -> str:
    name = facts.validated_text("the name of an object", name).strip()
    if _RESERVED_NAME.fullmatch(name):
        raise InputError(
            f"{name!r} cannot be the name of an object: it has the form of an id or a point", code="invalid_name"
        )
    return name


def _check_free(annotations: Mapping[int, ObjectAnnotations], number: int, name: str) -> None:
    for other, annotation in annotations.items():
        if other != number and annotation.name.casefold() == name.casefold():
            raise InputError(
                f"o{other} has the name {annotation.name!r} already: choose another name, rename that object, or mark "
                f"both as the same object (--same-as o{other})",
                code="name_taken",
            )


def _check_acyclic(annotations: Mapping[int, ObjectAnnotations], number: int, same_as: str) -> None:
    seen = {f"o{number}"}
    at: str | None = same_as
    while at:
        if at in seen:
            raise InputError(f"o{number} and {same_as} are the same object already", code="already_same")
        seen.add(at)
        at = annotations.get(number_of(at) or 0, ObjectAnnotations()).same_as


# --- rows ------------------------------------------------------------------------------------------------------------


def forget_sets(connection: Connection, scenes: Iterable[str]) -> int:
    """Delete the object sets that contain any of these captures; return their number."""
    gone = set(scenes)
    rows = connection.execute(SETS.select(SETS.c.number, SETS.c.scenes)).all()
    numbers = [row.number for row in rows if not gone.isdisjoint(row.scenes.split(" "))]
    connection.execute(SETS.delete(SETS.c.number.in_(numbers)))
    return len(numbers)


def forget_scene(connection: Connection, scene: str) -> dict[str, int]:
    """Delete the boxes of a capture, and facts about objects that no other capture shows; return row counts by noun."""
    dropped = {}
    mine = object_places.c.scene == scene
    of_it = list(connection.execute(select(object_places.c.object).where(mine)).scalars())
    dropped["object_places"] = int(connection.execute(delete(object_places).where(mine)).rowcount)
    left = set(connection.execute(select(object_places.c.object)).scalars())
    lost = object_facts.c.object.in_([number for number in of_it if number not in left])
    dropped["object_facts"] = int(connection.execute(delete(object_facts).where(lost)).rowcount)
    return dropped


def inherit(connection: Connection, old: str, new: str) -> None:
    """Move the object boxes of a capture to another capture in the same frame."""
    has = set(connection.execute(select(object_places.c.object).where(object_places.c.scene == new)).scalars())
    moving = (object_places.c.scene == old) & object_places.c.object.not_in(has)
    connection.execute(update(object_places).where(moving).values(scene=new))
    forget_sets(connection, [old])


def _value(made: ObjectSet) -> dict[str, Any]:
    scenes = list(made.poses)
    at = {scene: i for i, scene in enumerate(scenes)}
    return {
        "metres": made.metres,
        "up": plain(made.up),
        "rooms": [
            {
                "low": plain(room.low),
                "shape": list(room.cells.shape),
                "cells": base64.b64encode(zlib.compress(np.packbits(room.cells).tobytes())).decode(),
                "cell_m": room.cell_m,
                "heights_m": [room.floor_m, room.ceiling_m],
                "doors": list(room.doors),
            }
            for room in made.rooms
        ],
        "things": [made.things.get(scene, "") for scene in scenes],
        "graphs": [made.graphs.get(scene, "") for scene in scenes],
        "boxes": [_box_or_none(made.boxes.get(scene)) for scene in scenes],
        "views": [_box_or_none(made.views.get(scene)) for scene in scenes],
        "surfaces": [_box_or_none(made.surfaces.get(scene)) for scene in scenes],
        "told": dict(made.told),
        "objects": [
            {
                "id": thing.id,
                "component": thing.component,
                "box": plain(thing.box),
                "position": plain(thing.position),
                "colour": plain(thing.colour),
                "building": thing.is_building,
                "sightings": [
                    [at[s.scene], s.state, s.thing, _box_or_none(s.box), s.looked, at.get(s.asked, -1)]
                    for s in thing.sightings
                ],
            }
            for thing in made.objects
        ],
    }


def _box_or_none(box: np.ndarray | None) -> list[list[float]] | None:
    return None if box is None else box.tolist()


def _read(row: Row[Any]) -> ObjectSet:
    with malformed_as_corrupt(f"objects, in results row {row.number},"):
        value, poses = row.about, row.about["poses"]
        scenes = row.scenes.split(" ")
        if set(scenes) != set(poses):
            raise InputError("its captures are not those of its poses", code="invalid_record")
        things = dict(zip(scenes, map(str, value["things"]), strict=True))
        return ObjectSet(
            row.key,
            row.recipe or "",
            float(value["metres"]),
            {scene: to_pose(pose) for scene, pose in poses.items()},
            things,
            _objects(value["objects"], scenes),
            _numbers(value["up"], (3,)),
            tuple(_room(one, len(value["rooms"])) for one in value["rooms"]),
            # Sets of older releases lack what follows, and are computed again.
            dict(zip(scenes, map(str, value.get("graphs", [""] * len(scenes))), strict=True)),
            _boxes(scenes, value.get("boxes")),
            _boxes(scenes, value.get("views")),
            _boxes(scenes, value.get("surfaces")),
            {str(pair): str(text) for pair, text in value.get("told", {}).items()},
        )


def _objects(rows: Sequence[Mapping[str, Any]], scenes: Sequence[str]) -> tuple[MapObject, ...]:
    """Read the objects of a set; numbers of all objects are converted at once, which is far faster."""
    boxes = _numbers([one["box"] for one in rows], (len(rows), 2, 3)) if rows else np.zeros((0, 2, 3))
    positions = _numbers([one["position"] for one in rows], (len(rows), 3)) if rows else np.zeros((0, 3))
    colours = _numbers([one["colour"] for one in rows], (len(rows), 3)) if rows else np.zeros((0, 3))
    shown = [box for one in rows for _, _, _, box, _, _ in one["sightings"] if box is not None]
    corners = iter(_numbers(shown, (len(shown), 2, 3)) if shown else ())
    out = []
    for one, box, position, colour in zip(rows, boxes, positions, colours.astype(np.float32), strict=True):
        if number_of(str(one["id"])) is None:
            raise InputError(f"an object with the id {one['id']!r}", code="invalid_record")
        observations: dict[int, ObjectObservation] = {}
        for at, state, thing, shown_box, looked, asked in one["sightings"]:
            if state not in OBSERVATION_STATES or not 0 <= at < len(scenes) or not -1 <= asked < len(scenes):
                raise InputError(f"an observation with the state {state!r}", code="invalid_record")
            own = None if shown_box is None else next(corners)
            by = "" if asked < 0 else scenes[asked]
            observations[at] = ObjectObservation(scenes[at], state, int(thing), own, float(looked), by)
        every = tuple(observations[at] for at in sorted(observations))
        component, is_building = int(one["component"]), bool(one.get("building", False))
        out.append(MapObject(str(one["id"]), component, box, position, colour, every, is_building=is_building))
    return tuple(out)


def _boxes(scenes: Sequence[str], values: Sequence[Any] | None) -> dict[str, np.ndarray]:
    """Read the boxes (2, 3) of scenes."""
    values = values or [None] * len(scenes)
    return {scene: _numbers(box, (2, 3)) for scene, box in zip(scenes, values, strict=True) if box is not None}


def _room(one: Mapping[str, Any], count: int) -> Room:
    width, depth = (int(n) for n in one["shape"])
    if not (0 < width * depth <= _MAX_CELLS and width > 0):
        raise InputError(f"a room with {width} x {depth} cells", code="invalid_record")
    packed = zlib.decompressobj().decompress(base64.b64decode(one["cells"], validate=True), -(-width * depth // 8))
    cells = np.unpackbits(np.frombuffer(packed, np.uint8), count=width * depth).astype(bool).reshape(width, depth)
    floor, ceiling = _numbers(one["heights_m"], (2,)).tolist()
    doors = tuple(int(other) for other in one["doors"])
    if not cells.any() or not float(one["cell_m"]) > 0 or not all(0 <= other < count for other in doors):
        raise InputError("a room without floor, or with a door that leads to no room", code="invalid_record")
    return Room(_numbers(one["low"], (2,)), cells, float(one["cell_m"]), floor, ceiling, doors)


def _numbers(value: Any, shape: tuple[int, ...]) -> np.ndarray:
    array = np.array(value, np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(f"expected {shape} finite numbers", code="invalid_record")
    return array

"""Objects of the map: their numbers, what people said of them, and what was computed of each component last.

An object keeps its number, and with it what was said of it, when objects are made again: it is found by where captures
show it, in their own frames, so that neither poses nor the order of captures matter. What was computed is a result that
the next one replaces.
"""

from __future__ import annotations

import base64
import re
import zlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any

import numpy as np
from sqlalchemy import Connection, Row, delete, insert, select, update

from gsmap.errors import CorruptError, GsmapError, InputError, NotFoundError
from gsmap.methods import RecipeKey
from gsmap.store import facts, recipes
from gsmap.store.catalog import Catalog, now
from gsmap.store.matrices import from_array, from_pose, to_pose
from gsmap.store.schema import object_facts, object_places, object_sets, objects
from gsmap.types import MapObject, ObjectAnnotations, ObjectObservation, Room, Sim3
from gsmap.types.map_object import OBSERVATION_STATES
from gsmap.types.plain import plain

Places = Mapping[str, np.ndarray]
"""Where captures show an object: (2, 3) box around it in the capture's own frame, by scene id."""

# Boxes of one object by two computations overlap by this share of what they cover together, each made larger first by
# a share of the larger one's diagonal: that of a picture on a wall has no thickness to speak of.
_SAME_SHARE = 0.1
_PAD = 0.03

_MAX_CELLS = 1 << 24  # of a room: hundreds of metres wide

_NUMBER = re.compile(r"o([1-9][0-9]{0,8})")
_NO_NAME = re.compile(r"o[0-9]+|[0-9a-f]{8}|[-+0-9.eE,\s]+")  # these are ids and points


@dataclass(frozen=True)
class ObjectFact:
    """One thing that was said of an object.

    Args:
        kind: of `gsmap.types.map_object.OBJECT_FACTS`.
        value: the text; empty where what was said before was taken back.
        author: who said it; empty where a person did and was not named.
        created_at: when.
    """

    kind: str
    value: str
    author: str
    created_at: str


@dataclass(frozen=True, eq=False)
class ObjectSet:
    """What was computed of one component.

    Args:
        key: `RecipeKey.digest`, of the recipe and of what it was made from.
        recipe: `RecipeKey.recipe`.
        metres: per unit of the map.
        poses: ``S_map_scene`` of its captures by scene id, as it was made with.
        things: digest of what each of them shows, by scene id.
        objects: with numbers for ids; without photographs and without what people say. The frame is that of ``poses``.
        up: (3,) against gravity in that frame.
        rooms: in the level frame of ``up`` (`gsmap.geometry.directions.level_frame`), the largest first.
    """

    key: str
    recipe: str
    metres: float
    poses: dict[str, Sim3]
    things: dict[str, str]
    objects: tuple[MapObject, ...]
    up: np.ndarray = field(default_factory=lambda: np.array([0.0, 0, 1]))
    rooms: tuple[Room, ...] = ()


@dataclass(frozen=True, eq=False)
class Computed:
    """What was computed of one component, to be kept.

    Args:
        made: its objects, the ids of which are replaced by numbers.
        places: where captures show each of them.
        key: what it is kept under.
    """

    made: ObjectSet
    places: Sequence[Places]
    key: RecipeKey


def number_of(text: str) -> int | None:
    """The number of an object by what it is called (``o12``); None for anything else."""
    found = _NUMBER.fullmatch(text)
    return None if found is None else int(found[1])


class Objects:
    """The objects of a map."""

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog

    # --- what was computed -------------------------------------------------------------------------------------------

    def sets(self) -> list[ObjectSet]:
        """What was computed last of every component.

        Raises:
            CorruptError: what the catalog holds makes no sense.
        """
        with self._catalog.read() as connection:
            rows = connection.execute(select(object_sets).order_by(object_sets.c.number)).all()
        return [_read(row) for row in rows]

    def save(self, parts: Sequence[Computed]) -> list[ObjectSet]:
        """Keep what was computed of components, in the place of what knew any of their captures before.

        No number is given twice in the map. Where a component came apart, the part of which more captures show an
        object keeps its number; the other part has a new object, see `parted`.

        Returns:
            The same with the numbers that objects have, or have now, instead of ids.
        """
        with self._catalog.write() as connection:
            forget_sets(connection, [scene for part in parts for scene in part.made.poses])
            found = [places for part in parts for places in part.places]
            given = _given(connection)
            numbers = matched(connection, found, given)
            when = now()
            made: list[int] = []
            for number in numbers:
                if number is None:
                    new = connection.execute(insert(objects).returning(objects.c.number), {"created_at": when})
                    number = int(new.scalar_one())
                made.append(number)
            rest = iter(made)
            return [
                self._save(connection, part, list(islice(rest, len(part.places))), given.union(made), when)
                for part in parts
            ]

    def _save(
        self, connection: Connection, part: Computed, numbers: Sequence[int], given: Collection[int], when: str
    ) -> ObjectSet:
        """Keep one component.

        Args:
            numbers: of its objects.
            given: of all objects of the map.
        """
        made = part.made
        kept = replace(
            made,
            objects=tuple(replace(thing, id=f"o{number}") for thing, number in zip(made.objects, numbers, strict=True)),
        )
        self._follow(connection, part, set(given) - set(numbers))
        mine = object_places.c.object.in_(numbers)
        connection.execute(delete(object_places).where(mine, object_places.c.scene.in_(list(made.poses))))
        rows = [
            {"object": number, "scene": scene, "box": from_array(box)}
            for number, places in zip(numbers, part.places, strict=True)
            for scene, box in places.items()
        ]
        if rows:
            connection.execute(insert(object_places), rows)
        value = {
            "key": part.key.digest,
            "recipe": recipes.keep(connection, part.key),
            "poses": {scene: from_pose(pose) for scene, pose in made.poses.items()},
            "value": _value(kept),
            "created_at": when,
        }
        connection.execute(insert(object_sets), value)
        return kept

    def _follow(self, connection: Connection, part: Computed, others: Collection[int]) -> None:
        """Let an object of another component that was one with an object here until they came apart know its place.

        The two are found at equal places then, so that each keeps its number, and they are one when the components are.
        """
        in_scenes = object_places.c.scene.in_(list(part.made.poses))
        for row in connection.execute(select(object_places).where(in_scenes)).all():
            if row.object in others:
                here = np.array([places[row.scene] for places in part.places if row.scene in places])
                share = _overlaps(here, np.array([row.box], np.float64)).ravel() if len(here) else np.zeros(1)
                if share.max() >= _SAME_SHARE:
                    same = (object_places.c.object == row.object) & (object_places.c.scene == row.scene)
                    box = from_array(here[share.argmax()])
                    connection.execute(update(object_places).where(same).values(box=box))

    def numbers(self, places: Sequence[Places]) -> list[int | None]:
        """The numbers of objects, by where captures show them; None for those that have none. Nothing is kept."""
        captures = {scene for one in places for scene in one}
        with self._catalog.read() as connection:
            return matched(connection, places, _given(connection, besides=captures))

    def parted(self, shown: Mapping[int, Iterable[str]]) -> dict[int, int]:
        """Objects that were one with another until their component came apart: the other's number, by number.

        Args:
            shown: captures of its component, by the number of each object of the map.
        """
        components = {number: set(captures) for number, captures in shown.items()}
        with self._catalog.read() as connection:
            rows = connection.execute(select(object_places).order_by(object_places.c.object)).all()
        by_scene: dict[str, list[tuple[int, np.ndarray]]] = {}
        for row in rows:
            if row.object in components:
                by_scene.setdefault(row.scene, []).append((row.object, np.array(row.box, np.float64)))
        out: dict[int, int] = {}
        for scene, places in by_scene.items():
            here = [one for one in places if scene in components[one[0]]]
            elsewhere = [one for one in places if scene not in components[one[0]]]
            if here and elsewhere:
                share = _overlaps(np.array([box for _, box in here]), np.array([box for _, box in elsewhere]))
                for i, j in np.argwhere(share >= _SAME_SHARE):
                    out.setdefault(here[i][0], elsewhere[j][0])
        return out

    # --- what people say ---------------------------------------------------------------------------------------------

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
        """Say something of an object; what was said before stays in `facts`.

        Args:
            name: no other object's; empty to take it back.
            label: what kind of thing it is; empty to take it back.
            note: added to those that there are.
            same_as: number of the object that it is one with; 0 to take that back.
            author: who says so.

        Raises:
            NotFoundError: no such object.
            InputError: an empty text, one with control characters, a name that is taken or that looks like a number or
                a point, or objects that would be one with each other in a circle.
        """
        said: list[tuple[str, str]] = []
        if name is not None:
            said.append(("name", _checked_name(name) if name else ""))
        if label is not None:
            said.append(("label", facts.checked_text("a label", label).strip() if label else ""))
        if note is not None:
            said.append(("note", facts.checked_text("a note", note, lines=True)))
        if same_as is not None:
            said.append(("same_as", f"o{same_as}" if same_as else ""))
        if author:
            facts.checked_text("an author", author)
        with self._catalog.write() as connection:
            for one in (number, same_as or number):
                if connection.execute(select(objects.c.number).where(objects.c.number == one)).first() is None:
                    raise NotFoundError(
                        f"this map has no object o{one}: gsmap graph MAP lists them", code="object_not_found"
                    )
            words = standing(connection)
            mine = words.get(number, ObjectAnnotations())
            said = [(kind, value) for kind, value in said if kind == "note" or getattr(mine, kind) != value]
            for kind, value in said:
                if kind == "name" and value:
                    _check_free(words, number, value)
                if kind == "same_as" and value:
                    _check_no_circle(words, number, value)
            rows = [
                {"object": number, "kind": kind, "value": value, "author": author, "created_at": now()}
                for kind, value in said
            ]
            if rows:
                connection.execute(insert(object_facts), rows)

    def words(self) -> dict[str, ObjectAnnotations]:
        """What people say of objects now, by id (``o12``); those of which nobody said anything are left out."""
        with self._catalog.read() as connection:
            return {f"o{number}": words for number, words in standing(connection).items()}

    def facts(self) -> dict[str, list[ObjectFact]]:
        """Everything people ever said of objects, by id (``o12``), oldest first."""
        out: dict[str, list[ObjectFact]] = {}
        query = select(object_facts).order_by(object_facts.c.number)
        with self._catalog.read() as connection:
            for row in connection.execute(query):
                fact = ObjectFact(row.kind, row.value, row.author, row.created_at)
                out.setdefault(f"o{row.object}", []).append(fact)
        return out

    def places(self, number: int) -> dict[str, np.ndarray]:
        """Where captures show, or showed when they were asked last, an object: its `Places`."""
        query = select(object_places).where(object_places.c.object == number)
        with self._catalog.read() as connection:
            return {row.scene: np.array(row.box, np.float64) for row in connection.execute(query)}


# --- which object is which -------------------------------------------------------------------------------------------


def matched(connection: Connection, found: Sequence[Places], given: Collection[int] = ()) -> list[int | None]:
    """The number of each object that is found, None for a new one; each number is given once.

    The more captures show two at one place, the surer they are one; of two that are as sure, the one whose places all
    take part, then the older one.

    Args:
        given: numbers of other objects, which are not given again.
    """
    known: dict[str, list[tuple[int, np.ndarray]]] = {}
    counts: dict[int, int] = {}
    for row in connection.execute(select(object_places)):
        known.setdefault(row.scene, []).append((row.object, np.array(row.box, np.float64)))
        counts[row.object] = counts.get(row.object, 0) + 1
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
        for a, b in np.argwhere(share >= _SAME_SHARE):
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


def _given(connection: Connection, besides: Iterable[str] = ()) -> set[int]:
    """Numbers of the objects that are kept as computed; of sets with any of the captures ``besides`` none."""
    out, others = set(), set(besides)
    for row in connection.execute(select(object_sets)):
        if not others & set(row.poses):
            out |= {number for thing in _read(row).objects if (number := number_of(thing.id)) is not None}
    return out


def _overlaps(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(N, M) share of what two boxes cover together that both cover, of boxes (N, 2, 3) and (M, 2, 3)."""
    size = np.maximum(
        np.linalg.norm(a[:, 1] - a[:, 0], axis=1)[:, None], np.linalg.norm(b[:, 1] - b[:, 0], axis=1)[None]
    )
    pad = np.maximum(_PAD * size, 1e-9)[..., None]
    low = np.maximum(a[:, None, 0], b[None, :, 0]) - pad
    high = np.minimum(a[:, None, 1], b[None, :, 1]) + pad
    both = np.clip(high - low, 0, None).prod(2)
    ours = (a[:, None, 1] - a[:, None, 0] + 2 * pad).prod(2)
    theirs = (b[None, :, 1] - b[None, :, 0] + 2 * pad).prod(2)
    found: np.ndarray = both / (ours + theirs - both)
    return found


# --- words -----------------------------------------------------------------------------------------------------------


def standing(connection: Connection) -> dict[int, ObjectAnnotations]:
    """What people say of objects now, by number."""
    said: dict[int, dict[str, str]] = {}
    for row in connection.execute(select(object_facts).order_by(object_facts.c.number)):
        said.setdefault(row.object, {})[row.kind] = row.value
    return {number: ObjectAnnotations(**values) for number, values in said.items() if any(values.values())}


def _checked_name(name: str) -> str:
    name = facts.checked_text("the name of an object", name).strip()
    if _NO_NAME.fullmatch(name):
        raise InputError(f"an object cannot be called {name!r}: ids and points look so", code="invalid_name")
    return name


def _check_free(words: Mapping[int, ObjectAnnotations], number: int, name: str) -> None:
    for other, said in words.items():
        if other != number and said.name.casefold() == name.casefold():
            raise InputError(
                f"o{other} is called {said.name!r} already: choose another name, rename that one, or say that the two "
                f"are one (--same-as o{other})",
                code="name_taken",
            )


def _check_no_circle(words: Mapping[int, ObjectAnnotations], number: int, same_as: str) -> None:
    seen = {f"o{number}"}
    at: str | None = same_as
    while at:
        if at in seen:
            raise InputError(
                f"o{number} and {same_as} are said to be one already, or are the same object", code="already_same"
            )
        seen.add(at)
        at = words.get(number_of(at) or 0, ObjectAnnotations()).same_as


# --- rows ------------------------------------------------------------------------------------------------------------


def forget_sets(connection: Connection, scenes: Iterable[str]) -> int:
    """Drop what was computed with any of these captures; how many results went."""
    gone = set(scenes)
    rows = connection.execute(select(object_sets.c.number, object_sets.c.poses)).all()
    numbers = [row.number for row in rows if gone & set(row.poses)]
    connection.execute(delete(object_sets).where(object_sets.c.number.in_(numbers)))
    return len(numbers)


def forget_scene(connection: Connection, scene: str) -> dict[str, int]:
    """Drop all that is known of objects by a capture, and what was said of those that no other shows; rows by noun."""
    dropped = {"object_sets": forget_sets(connection, [scene])}
    mine = object_places.c.scene == scene
    of_it = list(connection.execute(select(object_places.c.object).where(mine)).scalars())
    dropped["object_places"] = int(connection.execute(delete(object_places).where(mine)).rowcount)
    left = set(connection.execute(select(object_places.c.object)).scalars())
    lost = object_facts.c.object.in_([number for number in of_it if number not in left])
    dropped["object_facts"] = int(connection.execute(delete(object_facts).where(lost)).rowcount)
    return dropped


def inherit(connection: Connection, old: str, new: str) -> None:
    """Let the objects that a capture shows be shown by another, in whose frame it is."""
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
        "scenes": scenes,
        "things": [made.things.get(scene, "") for scene in scenes],
        "objects": [
            {
                "id": thing.id,
                "component": thing.component,
                "box": plain(thing.box),
                "position": plain(thing.position),
                "colour": plain(thing.colour),
                # Of captures that cannot have looked nothing is kept.
                "sightings": [
                    [at[s.scene], s.state, s.thing, plain(s.box), s.looked, at.get(s.asked, -1)]
                    for s in thing.sightings
                    if s.state != "unseen" or s.asked
                ],
            }
            for thing in made.objects
        ],
    }


def _read(row: Row[Any]) -> ObjectSet:
    try:
        value = row.value
        scenes = [str(scene) for scene in value["scenes"]]
        if set(scenes) != set(row.poses):
            raise InputError("its captures are not those of its poses", code="invalid_record")
        things = dict(zip(scenes, map(str, value["things"]), strict=True))
        return ObjectSet(
            row.key,
            row.recipe or "",
            float(value["metres"]),
            {scene: to_pose(pose) for scene, pose in row.poses.items()},
            things,
            tuple(_object(one, scenes, things) for one in value["objects"]),
            _numbers(value["up"], (3,)),
            tuple(_room(one, len(value["rooms"])) for one in value["rooms"]),
        )
    except (GsmapError, TypeError, ValueError, KeyError, IndexError, AttributeError, zlib.error) as error:
        raise CorruptError(
            f"the catalog holds objects, in object_sets row {row.number}, that make no sense ({error}): gsmap did not "
            "write that; restore the catalog from a backup",
            code="catalog_invalid",
        ) from error


def _object(one: Mapping[str, Any], scenes: Sequence[str], things: Mapping[str, str]) -> MapObject:
    said: dict[int, ObjectObservation] = {}
    for at, state, thing, box, looked, asked in one["sightings"]:
        if state not in OBSERVATION_STATES or not 0 <= at < len(scenes) or not -1 <= asked < len(scenes):
            raise InputError(f"a sighting of {state!r}", code="invalid_record")
        corners = None if box is None else _numbers(box, (2, 3))
        by = "" if asked < 0 else scenes[asked]
        said[at] = ObjectObservation(scenes[at], state, int(thing), corners, float(looked), by)
    if number_of(str(one["id"])) is None:
        raise InputError(f"an object called {one['id']!r}", code="invalid_record")
    # Captures whose things nobody knows tell nothing of any.
    every = tuple(
        said.get(i, ObjectObservation(scene, "unseen", -1, None, 0.0))
        for i, scene in enumerate(scenes)
        if things[scene]
    )
    colour = _numbers(one["colour"], (3,)).astype(np.float32)
    box, position = _numbers(one["box"], (2, 3)), _numbers(one["position"], (3,))
    return MapObject(str(one["id"]), int(one["component"]), box, position, colour, every)


def _room(one: Mapping[str, Any], count: int) -> Room:
    width, depth = (int(n) for n in one["shape"])
    if not (0 < width * depth <= _MAX_CELLS and width > 0):
        raise InputError(f"a room of {width} x {depth} cells", code="invalid_record")
    packed = zlib.decompressobj().decompress(base64.b64decode(one["cells"], validate=True), -(-width * depth // 8))
    cells = np.unpackbits(np.frombuffer(packed, np.uint8), count=width * depth).astype(bool).reshape(width, depth)
    floor, ceiling = _numbers(one["heights_m"], (2,)).tolist()
    doors = tuple(int(other) for other in one["doors"])
    if not cells.any() or not float(one["cell_m"]) > 0 or not all(0 <= other < count for other in doors):
        raise InputError("a room without floor, or with a door to nowhere", code="invalid_record")
    return Room(_numbers(one["low"], (2,)), cells, float(one["cell_m"]), floor, ceiling, doors)


def _numbers(value: Any, shape: tuple[int, ...]) -> np.ndarray:
    array = np.array(value, np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(f"{shape} finite numbers are wanted", code="invalid_record")
    return array

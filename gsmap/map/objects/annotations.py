"""Apply the annotations that people gave objects: names, labels, notes and merges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from gsmap.map.date_filter import capture_time
from gsmap.store import Store
from gsmap.store.objects import number_of
from gsmap.texts import few
from gsmap.types import MapObject, ObjectAnnotations, ObjectObservation, Scene


def why_distinct(one: MapObject, other: MapObject, scenes: Mapping[str, Scene]) -> str:
    """Return the reason why two objects cannot be the same; empty if they can."""
    if one.component != other.component:
        return "they lie in two components, whose relative pose is unknown"
    shown = {sighting.scene for sighting in one.sightings if sighting.thing >= 0}
    both = [s.scene for s in other.sightings if s.thing >= 0 and s.scene in shown and one is not other]
    return f"{scenes[both[0]].name} shows both" if both else ""


def apply_annotations(
    store: Store, objects: Sequence[MapObject], scenes: Mapping[str, Scene]
) -> tuple[list[MapObject], dict[str, str], list[str]]:
    """Add annotations to objects and join the objects that are annotated as the same.

    Returns:
        Also the id that each is told under that was joined to another, and what of the words cannot be told so.
    """
    words, notes = store.objects.annotations(), []
    of = {thing.id: replace(thing, words=words.get(thing.id, ObjectAnnotations())) for thing in objects}
    joined: dict[str, str] = {}
    ordered = sorted(scenes.values(), key=lambda scene: capture_time(scene.captured_at, scene.ingested_at))
    rank = {scene.id: i for i, scene in enumerate(ordered)}
    for thing in list(of.values()):
        target = _end_of(thing.words.same_as, words, of, joined)
        if not target or target == thing.id:
            continue
        if why := why_distinct(of[thing.id], of[target], scenes):
            notes.append(f"{thing.id} is not joined with {target}, although annotated as the same: {why}")
            continue
        of[target] = _as_one(of[target], of.pop(thing.id), rank)
        joined = {one: target if to == thing.id else to for one, to in joined.items()} | {thing.id: target}
    for name, said in words.items():
        if name not in of and name not in joined and (number := number_of(name)) is not None:
            places = [scenes[scene].name for scene in store.objects.places(number) if scene in scenes]
            if places:
                called = f" ({said.name or said.label})" if said.name or said.label else ""
                notes.append(f"{name}{called} is not found any more; it was a segment of {few(places)}")
    return [of[thing.id] for thing in objects if thing.id in of], joined, notes


def _end_of(
    start: str, words: Mapping[str, ObjectAnnotations], of: Mapping[str, MapObject], joined: Mapping[str, str]
) -> str:
    """Follow ``same_as`` annotations to an existing object; return an empty text without one."""
    at, passed = start, set[str]()
    while at and at not in of and at not in passed:
        passed.add(at)
        at = joined.get(at) or words.get(at, ObjectAnnotations()).same_as
    return at if at in of else ""


def _as_one(one: MapObject, other: MapObject, rank: Mapping[str, int]) -> MapObject:
    """Join two objects of one component into the first. For a scene in which neither object has a segment, keep the
    observation of the object that was seen nearest in time.

    Args:
        rank: place of each scene in the order of time.
    """
    shown = [[rank[s.scene] for s in thing.sightings if s.thing >= 0] for thing in (one, other)]
    pairs: dict[str, list[tuple[int, ObjectObservation]]] = {}
    for k, thing in enumerate((one, other)):
        for sighting in thing.sightings:
            pairs.setdefault(sighting.scene, []).append((k, sighting))
    sightings = []
    for scene in sorted(pairs, key=rank.__getitem__):
        i = rank[scene]

        def order(pair: tuple[int, ObjectObservation], i: int = i) -> tuple[bool, bool, bool, int]:
            k, sighting = pair
            nearest = min((abs(i - j) for j in shown[k]), default=len(rank))
            return sighting.thing < 0, sighting.state != "seen", sighting.state == "unseen", nearest

        sightings.append(min(pairs[scene], key=order)[1])
    last = one if max(shown[0], default=-1) >= max(shown[1], default=-1) else other
    words = ObjectAnnotations(
        one.words.name or other.words.name,
        one.words.label or other.words.label,
        one.words.note or other.words.note,
        one.words.same_as,
    )
    return replace(last, id=one.id, sightings=tuple(sightings), words=words)

"""Add the observations of stored photos to objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from gsmap.map.date_filter import capture_time
from gsmap.store.photos import StoredPhoto
from gsmap.types import MapObject, ObjectObservation, Scene, Sim3

_SAME_PLACE_M = 0.15  # distance of an observation from the box of its object


def add_photo_observations(
    objects: Sequence[MapObject],
    kept: Sequence[StoredPhoto],
    scenes: Mapping[str, Scene],
    poses: Mapping[str, Sim3],
    metres: Mapping[int, float],
    components: Mapping[str, int],
) -> list[MapObject]:
    """Add the observations of stored photos to objects, in the order of dates.

    What a photo said of a thing holds for the object that stands or stood at that place.

    Args:
        poses: ``S_map_scene`` by scene id. components: the same of components.
        metres: per unit, by component.
    """
    said: dict[int, dict[str, ObjectObservation]] = {}
    for photo in kept:
        one = photo.sighting
        if one.scene not in poses:
            continue
        component = components[one.scene]
        for thing in one.things:
            at = poses[one.scene].apply(thing.position)
            number = _at(objects, component, at, _SAME_PLACE_M / metres[component])
            if number is not None:
                sighting = ObjectObservation(one.digest, thing.state, -1, None, thing.share)
                said.setdefault(number, {}).setdefault(one.digest, sighting)
    whens = {scene.id: capture_time(scene.captured_at, scene.ingested_at) for scene in scenes.values()}
    whens |= {photo.sighting.digest: capture_time(photo.sighting.captured_at, photo.created_at) for photo in kept}
    out = list(objects)
    for number, sightings in said.items():
        everything = [*objects[number].sightings, *sightings.values()]
        ordered = sorted(everything, key=lambda sighting: whens[sighting.scene])
        out[number] = replace(objects[number], sightings=tuple(ordered))
    return out


def _at(objects: Sequence[MapObject], component: int, at: np.ndarray, near: float) -> int | None:
    """Return the index of the object at a point; among several objects, the one with the nearest box centre."""
    best, far = None, np.inf
    for number, thing in enumerate(objects):
        if thing.component != component:
            continue
        for sighting in thing.sightings:
            if sighting.box is None or not ((at >= sighting.box[0] - near) & (at <= sighting.box[1] + near)).all():
                continue
            distance = float(np.linalg.norm(at - sighting.box.mean(0)))
            if distance < far:
                best, far = number, distance
    return best

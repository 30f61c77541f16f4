"""Photographs that a map keeps, beside its objects: what each says of them, and where that stands in histories."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

from gsmap.localize import ChangedRegion, PhotoComparison
from gsmap.map.localization.photos import objects_in_photo
from gsmap.map.objects.map_objects import MapObjects, history_report, objects_report
from gsmap.map.objects.photo_observations import add_photo_observations
from gsmap.objects import estimate_persistence
from gsmap.store.photos import StoredPhoto
from gsmap.types import MapObject, ObjectObservation, Sim3
from gsmap.types.localized_photo import LocalizedPhoto, PhotoObjectObservation

LENS = np.array([100.0, 100, 50, 40])
HEIGHT, WIDTH = 80, 100
DEPTH = 4.0


@dataclass
class Sketch:
    """A wall 4 m before a camera at the origin, and a thing on it: a square of samples of half a metre."""

    def thing(self, at=(0.0, 0.0)):
        grid = np.stack(np.meshgrid(np.linspace(-0.25, 0.25, 12), np.linspace(-0.25, 0.25, 12)), -1).reshape(-1, 2)
        return np.c_[grid + at, np.full(len(grid), DEPTH)]

    def found(self, mask=None, kind="disappeared"):
        v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
        points = np.stack([(u - 50) / 100 * DEPTH, (v - 40) / 100 * DEPTH, np.full(u.shape, DEPTH)], -1)
        compared = np.ones((HEIGHT, WIDTH), bool)
        mask = np.zeros((HEIGHT, WIDTH), bool) if mask is None else mask
        region = ChangedRegion(np.zeros(4), float(mask.mean()), 2.0, kind, mask, np.zeros(3), "a")
        regions = (region,) if mask.any() else ()
        return PhotoComparison(
            regions, 1.0, compared, compared & ~mask, np.zeros((HEIGHT, WIDTH, 3)), points, np.ones(4)
        )


@dataclass
class OneThing:
    samples: np.ndarray
    sample_counts: np.ndarray

    def __len__(self) -> int:
        return 1


def middle() -> np.ndarray:
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    return (np.abs(u - 50) < 8) & (np.abs(v - 40) < 8)


def an_object(*sightings: ObjectObservation, at=(0.0, 0.0, DEPTH), name="aaaaaaaa") -> MapObject:
    box = np.array([np.array(at) - 0.25, np.array(at) + 0.25])
    return MapObject(name, 0, box, np.array(at), np.zeros(3, np.float32), sightings)


def seen(scene: str, at=(0.0, 0.0, DEPTH)) -> ObjectObservation:
    return ObjectObservation(scene, "seen", 0, np.array([np.array(at) - 0.25, np.array(at) + 0.25]))


def said(found: PhotoComparison, samples: np.ndarray) -> list[PhotoObjectObservation]:
    things = OneThing(samples, np.array([len(samples)]))
    row = SimpleNamespace(T_map_camera=np.eye(4), intrinsics_px=LENS, component=0)
    graph = SimpleNamespace(segments=things)
    poses = {"a": Sim3.identity()}
    return objects_in_photo(SimpleNamespace(found=found), row, 1.0, [an_object(seen("a"))], lambda scene: graph, poses)


def test_a_thing_that_the_photo_shows_is_seen():
    (one,) = said(Sketch().found(), Sketch().thing())
    assert (one.state, one.share) == ("seen", 1.0)
    assert np.allclose(one.position, [0, 0, DEPTH])


def test_one_whose_place_shows_something_else_is_absent():
    (one,) = said(Sketch().found(middle()), Sketch().thing())
    assert one.state == "absent"


def test_of_what_something_new_hides_nothing_is_said():
    assert said(Sketch().found(middle(), "appeared"), Sketch().thing()) == []


def test_nor_of_what_the_map_itself_hides_or_the_photo_does_not_show():
    behind = Sketch().thing() + np.array([0, 0, 2.0])
    beside = Sketch().thing(at=(30.0, 0))
    assert said(Sketch().found(), behind) == []
    assert said(Sketch().found(), beside) == []


def kept(digest: str, when: str | None, *things: PhotoObjectObservation, scene="a") -> StoredPhoto:
    one = LocalizedPhoto(digest * 64, f"{digest}.jpg", when, scene, np.eye(4), np.eye(6), LENS, (100, 80), 0.99, things)
    return StoredPhoto(1, one, "2026-05-05T00:00:00+00:00")


def scene(name: str, when: str | None):
    return SimpleNamespace(id=name, name=name, captured_at=when, ingested_at="2026-01-01T00:00:00+00:00")


SCENES = {"a": scene("a", "2026-01-01T00:00:00+00:00"), "b": scene("b", "2026-06-01T00:00:00+00:00")}


def known(*photos: StoredPhoto, S: Sim3 | None = None) -> MapObjects:
    thing = an_object(seen("a"), seen("b"))
    at = {"a": S or Sim3.identity(), "b": Sim3.identity()}
    objects = add_photo_observations([thing], photos, SCENES, at, {0: 1.0}, {"a": 0, "b": 0})
    names = {one.sighting.digest: (one.sighting.name, one.sighting.captured_at, one.created_at) for one in photos}
    return MapObjects(objects, SCENES, (), {0: 1.0}, names)


ABSENT = PhotoObjectObservation(np.array([0.1, 0, DEPTH]), "absent", 0.8)


def test_photos_stand_among_captures_in_the_order_of_dates():
    told = known(kept("1", "2026-03-01T00:00:00+00:00", ABSENT), kept("2", None, ABSENT))
    rows = history_report(told, "aaaaaaaa", None).sightings
    assert [(row.scene_name, row.state) for row in rows] == [
        ("a", "seen"),
        ("1.jpg", "absent"),
        ("b", "seen"),
        ("2.jpg", "absent"),
    ]
    assert rows[1].captured_at == "2026-03-01T00:00:00+00:00"
    assert rows[1].looked == pytest.approx(0.8)
    assert rows[1].box is None


def test_a_later_photo_ends_what_stood_there():
    (before,) = objects_report(known()).objects
    (after,) = objects_report(known(kept("1", "2026-07-01T00:00:00+00:00", ABSENT))).objects
    assert before.there
    assert not after.there
    assert (after.seen, after.looks) == (before.seen, before.looks + 1)
    assert (
        estimate_persistence(known(kept("1", "2026-07-01T00:00:00+00:00", ABSENT)).objects[0], {}).half_life_days
        is None
    )


def test_what_is_said_of_another_place_is_of_another_thing():
    far = PhotoObjectObservation(np.array([3.0, 0, DEPTH]), "absent", 0.8)
    assert len(known(kept("1", None, far)).objects[0].sightings) == 2


def test_places_are_taken_along_when_the_map_moves():
    moved = Sim3(np.eye(3), np.array([-3.0, 0, 0]))
    far = PhotoObjectObservation(np.array([3.0, 0, DEPTH]), "absent", 0.8)
    assert len(known(kept("1", None, far), S=moved).objects[0].sightings) == 3

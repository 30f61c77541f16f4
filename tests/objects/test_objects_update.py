"""Objects and rooms of a street: a scene that comes or goes leaves what a computation from scratch finds."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
import pytest

from gsmap.objects import (
    ComponentScenes,
    RenderedViews,
    SegmentedScene,
    SurfacePoints,
    make_objects,
    update_objects,
    update_rooms,
)
from gsmap.types import MapObject, ObjectObservation, Segments, Sim3
from gsmap.types.room import Room

STEP_M, REACH_M, NUM = 3.0, 4.0, 14
SIZE = np.array([0.6, 0.5, 0.8])
RNG = np.random.default_rng(5)
PLACES = np.column_stack([np.arange(0.0, STEP_M * NUM, 1.1), *(RNG.uniform(-2, 2, (39, 2)).T * [[1], [0.2]])])
COLOURS = RNG.uniform(10, 80, (len(PLACES), 3))
NOTHING = RenderedViews((), (), ())


def segmented(k: int, lost: Collection[int] = ()) -> SegmentedScene:
    """Scene ``k`` at 3 k metres, in a frame of its own, with a segment for each thing within 4 m that is not lost."""
    rng = np.random.default_rng(k)
    S = Sim3(np.eye(3), np.array([STEP_M * k, 1.0, 0]))
    near = [i for i in range(len(PLACES)) if abs(PLACES[i, 0] - STEP_M * k) < REACH_M and i not in lost]
    samples = [PLACES[i] + rng.uniform(0, 1, (150, 3)) * SIZE + rng.normal(0, 0.01, 3) for i in near]
    own = [S.inverse().apply(points) for points in samples]
    colours = [COLOURS[i] + rng.normal(0, 2, (150, 3)) for i in near]
    counts = np.full(len(near), 150)
    segments = Segments(
        members=np.repeat(np.arange(len(near)), 150),
        positions=np.array([points.mean(0) for points in own]),
        extents=np.array([[points.min(0), points.max(0)] for points in own]),
        colours=np.array([one.mean(0) for one in colours]),
        samples=np.concatenate(own),
        sample_colours=np.concatenate(colours),
        sample_counts=counts,
    )
    return SegmentedScene(f"s{k:02d}", S, segments)


def street(ks: Sequence[int], loaded: list[str] | None = None, views_m: float = 5.0) -> ComponentScenes:
    """The scenes of a street; which of them are loaded is noted."""
    scenes = {one.scene: one for one in map(segmented, ks)}

    def load(scene: str) -> SegmentedScene:
        if loaded is not None:
            loaded.append(scene)
        return scenes[scene]

    boxes = {scene: one.box for scene, one in scenes.items() if one.box is not None}
    around = np.array([[-views_m] * 3, [views_m] * 3])
    views = {scene: one.S_map_scene.translation + around for scene, one in scenes.items()}
    return ComponentScenes(list(scenes), load, boxes, views)


def groups(objects: Sequence[MapObject]) -> set[frozenset[tuple[str, int]]]:
    return {frozenset((s.scene, s.thing) for s in thing.sightings if s.thing >= 0) for thing in objects}


@pytest.mark.parametrize("order", [range(NUM), [*range(0, NUM, 2), *range(1, NUM, 2)], [7, *range(7), *range(8, NUM)]])
def test_scenes_that_come_one_by_one_give_the_objects_of_all_at_once(order):
    whole = groups(make_objects([segmented(k) for k in range(NUM)], 0, lambda _: NOTHING))
    assert max(map(len, whole)) == 3
    objects, there = [], []
    for k in order:
        there = sorted([*there, k])
        objects = update_objects(street(there), 0, lambda _: NOTHING, earlier=objects, changed=[f"s{k:02d}"])
    assert groups(objects) == whole
    assert len({thing.id for thing in objects}) == len(objects)


def test_a_scene_that_goes_leaves_the_objects_of_the_others():
    objects = make_objects([segmented(k) for k in range(NUM)], 0, lambda _: NOTHING)
    left = [k for k in range(NUM) if k != 6]
    updated = update_objects(
        street(left), 0, lambda _: NOTHING, earlier=objects, changed=[], touched=[segmented(6).box]
    )
    assert groups(updated) == groups(make_objects([segmented(k) for k in left], 0, lambda _: NOTHING))


def test_only_what_a_new_scene_touches_is_loaded_and_looked_at():
    old = list(range(NUM))
    objects = make_objects([segmented(k) for k in old if k != 2], 0, lambda _: NOTHING)
    loaded, looked = [], []

    def render(scene: SegmentedScene) -> RenderedViews:
        looked.append(scene.scene)
        return NOTHING

    updated = update_objects(street(old, loaded), 0, render, earlier=objects, changed=["s02"])
    assert {int(scene[1:]) for scene in loaded} <= set(range(10))
    assert looked
    assert set(looked) <= {"s00", "s01", "s02", "s03", "s04", "s05"}
    far = [thing for thing in objects if thing.position[0] > 30]
    assert len(far) > 5
    assert all(thing in updated for thing in far)
    assert all(s.state == "seen" for thing in updated for s in thing.sightings), "what was not observed is not kept"


def walls(k: int) -> SurfacePoints:
    """A room of 5 x 4 m, with doors in the middle of its left and right walls, through which one sees floor."""
    step = 0.05
    x, y, z = (np.arange(step / 2, size, step) for size in (5.0, 4.0, 2.5))
    floor = np.stack(np.meshgrid(x, y, [0.0, 2.5]), -1).reshape(-1, 3)
    beyond = np.concatenate([x[x < 1] - 1, x[x < 1] + 5])
    floor = np.concatenate([floor, np.stack(np.meshgrid(beyond, y[abs(y - 2) < 0.5], [0.0]), -1).reshape(-1, 3)])
    along = np.stack(np.meshgrid(x, [0.0, 4.0], z), -1).reshape(-1, 3)
    across = np.stack(np.meshgrid([0.0, 5.0], y, z), -1).reshape(-1, 3)
    is_open = (abs(across[:, 1] - 2) < 0.5) & (across[:, 2] < 2.0)
    upright = np.concatenate([along, across[~is_open]])
    points = np.concatenate([floor, upright]) + np.array([5.0 * k, 0, 0])
    return SurfacePoints(points.astype(np.float32), np.arange(len(points)) < len(floor))


def rooms(ks: Sequence[int], earlier: Sequence[Room] = (), new: Sequence[int] | None = None, loaded=None) -> list[Room]:
    def load(scene: str) -> SurfacePoints:
        if loaded is not None:
            loaded.append(int(scene))
        return walls(int(scene))

    return update_rooms(
        {str(k): walls(k).box for k in ks},
        load,
        lambda scene: np.array([[5.0 * int(scene) + 2.5, 2, 1.5]]),
        1.5,
        earlier,
        None if new is None else [walls(k).box for k in new],
    )


def plan(found: Sequence[Room]) -> list[tuple[object, ...]]:
    """Of each room along the street its middle, its area and the middles of the rooms behind its doors."""
    return sorted(
        (*one.middle.round(1), round(one.area_m2), sorted(found[other].middle[0].round(1) for other in one.doors))
        for one in found
    )


def test_rooms_of_a_street_are_found_tile_by_tile():
    found = plan(rooms(range(30)))
    assert [row[0] for row in found] == pytest.approx([5 * k + 2.5 for k in range(30)], abs=0.15)
    assert all(row[3] == pytest.approx(20, abs=2) for row in found)
    assert [len(row[4]) for row in found] == [1, *[2] * 28, 1], "doors lead across tiles, too"


def test_a_new_room_segments_only_the_tiles_around_it():
    some, loaded = [k for k in range(30) if k != 29], []
    updated = rooms(range(30), rooms(some), [29], loaded)
    assert plan(updated) == plan(rooms(range(30)))
    assert min(loaded) > 12
    assert plan(rooms(range(30), updated, [])) == plan(updated)


@pytest.mark.parametrize("far_m", [1e7, 1e30])
def test_a_stray_point_far_away_changes_no_room(far_m):
    some = {str(k): walls(k) for k in range(15)}
    stray = np.concatenate([some["3"].points, np.full((1, 3), far_m, np.float32)])
    some["3"] = SurfacePoints(stray, np.append(some["3"].is_level, False))
    boxes = {scene: one.box for scene, one in some.items()}
    found = update_rooms(boxes, some.__getitem__, lambda scene: np.array([[5.0 * int(scene) + 2.5, 2, 1.5]]), 1.5)
    assert plan(found) == plan(rooms(range(15)))


@pytest.mark.guards("answers")
def test_rooms_of_a_scene_that_goes_go_with_it():
    """Four buildings 40 m apart; the last one leaves tiles without a scene."""
    there, left = [0, 8, 16, 24], [0, 8, 16]
    updated = rooms(left, rooms(there), [24])
    assert plan(updated) == plan(rooms(left))
    assert len(plan(updated)) == 3


@pytest.mark.guards("answers")
def test_a_scene_that_is_only_compared_again_keeps_what_it_observed():
    """Even where it cannot be searched any more, as a thinned scene."""
    objects = make_objects([segmented(k) for k in range(6)], 0, lambda _: NOTHING)
    watcher = "s04"
    places = {i for i, one in enumerate(objects) if all(s.scene != watcher for s in one.sightings)}
    told = [
        replace(
            one, sightings=(*one.sightings, ObjectObservation(watcher, "absent", -1, None, 0.5, one.sightings[0].scene))
        )
        if i in places
        else one
        for i, one in enumerate(objects)
    ]
    scenes = street(range(6))
    without_view = replace(scenes, views={scene: view for scene, view in scenes.views.items() if scene != watcher})
    for same, found in (([watcher], len(places)), ([], 0)):
        updated = update_objects(
            without_view, 0, lambda _: NOTHING, earlier=told, changed=[watcher], same=same, touched=[]
        )
        assert groups(updated) == groups(objects)
        assert sum(s.state == "absent" for one in updated for s in one.sightings) == found

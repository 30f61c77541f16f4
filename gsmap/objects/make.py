"""Construct the objects of the map from the segments of its scenes."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial

import numpy as np

from gsmap import render as rendering
from gsmap.geometry.directions import level_frame
from gsmap.methods import RecipeKey, text_digest
from gsmap.objects.building_parts import is_building_part
from gsmap.objects.component_scenes import (
    ComponentScenes,
    Match,
    SegmentedScene,
    SegmentRef,
    boxes_meet,
    no_match,
)
from gsmap.objects.outlines import Outline, measure_outlines
from gsmap.objects.regroup import Group, regroup
from gsmap.objects.visibility import LONGEST_SIDE_PX, MAX_VIEWS, RenderedViews, classify_observation, observe_points
from gsmap.settings.ranges import require_range
from gsmap.types import MapObject, ObjectObservation, ObservationState
from gsmap.types.plain import plain
from gsmap.types.progress import Progress, silent

VERSION = 5
"""Version, raised whenever the objects of the same scenes change, also through other modules of `gsmap.objects`."""

_FLOOR_AND_CEILING = (0.01, 0.995)  # quantiles of the heights of a scene's segments


@dataclass(frozen=True)
class Params:
    """Settings of objects: the association of segments, visibility tests and rooms.

    Args:
        min_gaussians: Smallest number of Gaussians, at least 0, that a segment must have to become an object; larger
            drops small objects.
        min_overlap: Smallest fraction in [0, 1] of the smaller of two segments that must lie in the cells of the larger
            segment for both segments to be one object; larger splits objects more often.
        max_views: Largest number of views of a scene, at least 1 and evenly spread, in which objects are searched for;
            larger leaves fewer objects unobserved and takes more time.
        longest_side_px: Longest side in pixels, at least 1, of the views in which objects are searched for; larger
            resolves smaller objects and takes more time.
        min_room_area_m2: Smallest floor area of a room in square metres, at least 0; larger drops closets.
    """

    min_gaussians: int = 40
    min_overlap: float = 0.45
    max_views: int = MAX_VIEWS
    longest_side_px: int = LONGEST_SIDE_PX
    min_room_area_m2: float = 1.5

    def __post_init__(self) -> None:
        require_range(self, "[0, inf]", "min_gaussians", "min_room_area_m2")
        require_range(self, "[0, 1]", "min_overlap")
        require_range(self, "[1, inf]", "max_views", "longest_side_px")


def recipe_key(params: Params | None = None) -> RecipeKey:
    """Return the recipe of the objects of a component, without its inputs."""
    return RecipeKey("objects", "fused", {"objects": VERSION}, plain(params or Params()), rendering.backend())


@dataclass(eq=False)
class _Object:
    """An object while its observations are collected.

    Args:
        members: its segment in each scene that shows it, oldest scene first.
        observations: by scene.
        earlier: the same object of an earlier run; None for a new object.
    """

    members: dict[str, int]
    observations: dict[str, ObjectObservation] = field(default_factory=dict)
    earlier: MapObject | None = None

    @cached_property
    def box(self) -> np.ndarray:
        """Box (2, 3) around the places of all its segments."""
        boxes = [self.observations[scene].box for scene in self.members]
        found = np.array([box for box in boxes if box is not None])
        return np.array([found[:, 0].min(0), found[:, 1].max(0)])


def make_objects(
    captures: Sequence[SegmentedScene],
    component: int,
    render: Callable[[SegmentedScene], RenderedViews],
    *,
    metres: float = 1.0,
    up: np.ndarray | None = None,
    match: Match = no_match,
) -> list[MapObject]:
    """Construct the objects of some scenes, oldest first, that may all see each other; see `update_objects`."""
    return update_objects(ComponentScenes.of(captures), component, render, metres=metres, up=up, match=match)


def update_objects(
    scenes: ComponentScenes,
    component: int,
    render: Callable[[SegmentedScene], RenderedViews],
    *,
    earlier: Sequence[MapObject] = (),
    changed: Collection[str] | None = None,
    same: Collection[str] = (),
    touched: Sequence[np.ndarray] = (),
    metres: float = 1.0,
    up: np.ndarray | None = None,
    match: Match = no_match,
    in_frustum: Callable[[SegmentedScene, np.ndarray], bool] = lambda capture, points: True,
    params: Params | None = None,
    progress: Progress = silent,
) -> list[MapObject]:
    """Construct the objects of one component of the map, the largest first, and after them parts of the building.

    Only segments near changed scenes are associated anew, and only pairs of an object and a scene are observed of which
    one is new and whose boxes meet. A scene is rendered at most once. So the cost of a new scene depends only on its
    own segments and on the objects at its place.

    Args:
        scenes: scenes of the component.
        render: function that renders the views of a scene.
        earlier: objects of an earlier run, in the frame of the scenes.
        changed: scenes that are new, moved, described anew or compared otherwise since; default: all.
        same: of these, scenes whose segments and pose are as they were, so that what they observed still holds.
        touched: boxes (2, 3) around the segments that scenes had at that time and have no more, map frame and unit.
        metres: metres per unit of the map.
        up: (3,) direction against gravity in the map frame; default: z.
        match: function that returns what comparisons of some scenes say of their segments; default: nothing.
        in_frustum: function that returns whether a camera of a scene has any of the points (scene frame and unit) in
            its frustum.
        params: see `Params`.
        progress: called with the fraction done in [0, 1] and the current step.
    """
    params = params or Params()
    changed = set(scenes.order if changed is None else changed)
    if not scenes.order:
        return []
    known = [_strip(one, scenes, changed, same) for one in earlier]
    broken = {i for i, one in enumerate(known) if len(one.members) < sum(s.thing >= 0 for s in earlier[i].sightings)}
    members = [one.members for one in known]
    groups, kept, told = regroup(scenes, members, broken, changed, touched, metres, params.min_overlap, match)
    objects = [known[i] for i in kept]
    for group in groups:
        if max(scenes.load(scene).num_members[segment] for scene, segment in group) >= params.min_gaussians:
            objects.append(_new(scenes, group))
    before = {
        (one.scene, one.asked, expected[one.asked]): one
        for i in set(range(len(known))).difference(kept)
        for expected in [_members(earlier[i], scenes, changed - set(same))]
        for one in known[i].observations.values()
        if one.asked in expected
    }
    shown: dict[str, list[int]] = {}
    for i, one in enumerate(objects):
        for scene in one.members:
            shown.setdefault(scene, []).append(i)
    asked = _pairs_to_observe(scenes, objects, changed)
    new = [_largest(scenes, one.members) for one in objects if one.earlier is None]
    kinds = _known_kinds(scenes, new, earlier, changed - set(same))
    to_measure: dict[str, list[SegmentRef]] = {}
    for largest in new:
        if largest not in kinds:
            to_measure.setdefault(largest[0], []).append(largest)
    level = np.eye(3) if up is None else level_frame(up)
    to_visit = [scene for scene in scenes.order if scene in asked or scene in to_measure]
    for done, scene in enumerate(to_visit):
        some = asked.get(scene, [])
        progress(done / len(to_visit), f"observing {len(some)} objects in scene {done + 1} of {len(to_visit)}")
        views = cache(partial(render, scenes.load(scene)))
        if some:
            _observe(scenes, objects, shown, scene, some, before, set(told.parted), metres, views, in_frustum)
        outlines = _outlines(scenes, scene, metres, views) if scene in to_measure and scene in scenes.views else []
        for segment in to_measure.get(scene, ()):
            kinds[segment] = _is_building(scenes, segment, level, metres, outlines[segment[1]] if outlines else None)
    return _sorted([_finished(scenes, one, component, kinds) for one in objects])


def _strip(thing: MapObject, scenes: ComponentScenes, changed: Collection[str], same: Collection[str]) -> _Object:
    """Return an earlier object without its segments in changed scenes, and without observations that no longer hold:
    by scenes that are gone, and by changed scenes that are not the ``same``.
    """
    members = _members(thing, scenes, changed)
    still = {scene for scene in scenes.rank if scene not in changed or scene in same}
    stays = {
        one.scene: one
        for one in thing.sightings
        if one.scene in members or (one.thing < 0 and one.scene in still and (one.asked or one.scene not in changed))
    }
    return _Object(members, stays, thing)


def _members(thing: MapObject, scenes: ComponentScenes, changed: Collection[str]) -> dict[str, int]:
    """Return the segment of an object in each scene that is there and has not changed."""
    return {
        one.scene: one.thing
        for one in thing.sightings
        if one.thing >= 0 and one.scene in scenes.rank and one.scene not in changed
    }


def _new(scenes: ComponentScenes, group: Group) -> _Object:
    made = _Object(dict(group))
    for scene, segment in group:
        points, _ = scenes.samples((scene, segment))
        box = np.array([points.min(0), points.max(0)])
        made.observations[scene] = ObjectObservation(scene, "seen", segment, box)
    return made


def _pairs_to_observe(
    scenes: ComponentScenes, objects: Sequence[_Object], changed: Collection[str]
) -> dict[str, list[int]]:
    """Return the indices of the objects that each scene may observe for the first time, by scene in order of time.

    A new object is observed by all scenes, and an earlier one by changed scenes, wherever their boxes meet.
    """
    ids = [scene for scene in scenes.order if scene in scenes.views]
    if not ids or not objects:
        return {}
    out: dict[str, list[int]] = {scene: [] for scene in ids}
    is_new = np.array([one.earlier is None for one in objects])
    for rows, some in (
        (np.flatnonzero(is_new).tolist(), ids),
        (np.flatnonzero(~is_new).tolist(), [scene for scene in ids if scene in changed]),
    ):
        if not len(rows) or not some:
            continue
        views, boxes = np.array([scenes.views[scene] for scene in some]), np.array([objects[i].box for i in rows])
        for at, row in np.argwhere(boxes_meet(views, boxes)).tolist():
            if some[at] not in objects[rows[row]].members:
                out[some[at]].append(rows[row])
    return {scene: sorted(asked) for scene, asked in out.items() if asked}


def _observe(
    scenes: ComponentScenes,
    objects: Sequence[_Object],
    shown: Mapping[str, Sequence[int]],
    scene: str,
    asked: Sequence[int],
    before: Mapping[tuple[str, str, int], ObjectObservation],
    parted: Collection[tuple[SegmentRef, str]],
    metres: float,
    views: Callable[[], RenderedViews],
    in_frustum: Callable[[SegmentedScene, np.ndarray], bool],
) -> None:
    """Observe objects in one scene, and add the observations to them.

    Args:
        shown: indices of the objects that each scene has a segment of.
        asked: indices of the objects.
        before: earlier observations that still hold, by scene and expected segment.
        parted: see `MatchedSegments`.
    """
    capture = scenes.load(scene)
    S_scene_map, unit = capture.S_map_scene.inverse(), metres * capture.S_map_scene.scale
    # The scene nearest in time provides the expected place of each object.
    expected = {i: scenes.nearest_in_time(objects[i].members, scene) for i in asked}
    results: dict[int, tuple[ObservationState, float]] = {}
    to_observe = []
    for i in asked:
        old = before.get((scene, *expected[i]))
        if old is not None:
            results[i] = old.state, old.looked
        elif in_frustum(capture, S_scene_map.apply(scenes.samples(expected[i])[0])):
            to_observe.append(i)
    if to_observe:
        seen = views()
        # Estimate exposure from objects that the scene certainly shows or, without any, from all objects with a surface
        # in place.
        sure = shown.get(scene) or to_observe
        expected |= {i: scenes.nearest_in_time(objects[i].members, scene) for i in sure}
        samples = {i: scenes.samples(expected[i]) for i in dict.fromkeys([*sure, *to_observe])}
        found = {i: observe_points(seen, S_scene_map.apply(points), unit) for i, (points, _) in samples.items()}
        off = np.concatenate([(found[i].colours - samples[i][1])[found[i].on] for i in sure])
        shift = np.median(off, axis=0) if len(off) else np.zeros(3)
        for i in to_observe:
            points, own = samples[i]
            results[i] = classify_observation(found[i], points * metres, own, shift)
    for i, (state, share) in results.items():
        asked_of = expected[i][0]
        if any((segment, scene) in parted for segment in objects[i].members.items()):
            state, asked_of = "absent", ""  # a review may revert it, so it is not kept as an observation
        if state == "unseen" and not share:
            continue
        points = scenes.samples(expected[i])[0]
        box = np.array([points.min(0), points.max(0)]) if state == "seen" else None
        objects[i].observations[scene] = ObjectObservation(scene, state, -1, box, share, asked_of)


def _outlines(scenes: ComponentScenes, scene: str, metres: float, views: Callable[[], RenderedViews]) -> list[Outline]:
    """Return the outlines of a scene's segments; empty if no view shows segments."""
    capture, seen = scenes.load(scene), views()
    unit_m = metres * capture.S_map_scene.scale
    return measure_outlines(seen, len(capture.segments), unit_m) if seen.segments else []


def _finished(scenes: ComponentScenes, made: _Object, component: int, kinds: Mapping[SegmentRef, bool]) -> MapObject:
    """Return the object with its observations, oldest first."""
    observed = tuple(sorted(made.observations.values(), key=lambda one: scenes.rank[one.scene]))
    if made.earlier is not None:
        same = made.earlier.component == component and observed == made.earlier.sightings
        return made.earlier if same else replace(made.earlier, component=component, sightings=observed)
    segments = list(made.members.items())
    (first, segment), (last, shown) = segments[0], segments[-1]
    oldest, newest = scenes.load(first).segments, scenes.load(last)
    own = oldest.positions[segment] * oldest.unit_m
    box = made.observations[last].box
    assert box is not None
    return MapObject(
        text_digest(f"{first} {np.round(own, 1).tolist()}")[:8],
        component,
        box,
        newest.S_map_scene.apply(newest.segments.positions[shown][None])[0],
        newest.segments.colours[shown],
        observed,
        is_building=kinds[_largest(scenes, made.members)],
    )


def _known_kinds(
    scenes: ComponentScenes, segments: Sequence[SegmentRef], earlier: Sequence[MapObject], changed: Collection[str]
) -> dict[SegmentRef, bool]:
    """Return whether objects are parts of the building, by those of some segments that decided it for earlier
    objects."""
    wanted, out = set(segments), {}
    for one in earlier:
        members = _members(one, scenes, changed)
        if wanted.isdisjoint(members.items()) or len(members) < sum(s.thing >= 0 for s in one.sightings):
            continue
        out[_largest(scenes, members)] = one.is_building
    return out


def _largest(scenes: ComponentScenes, members: Mapping[str, int]) -> SegmentRef:
    """Return the segment with most samples of an object; the oldest of several."""
    oldest_first = sorted(members.items(), key=lambda one: scenes.rank[one[0]])
    return max(oldest_first, key=lambda one: scenes.load(one[0]).segments.sample_counts[one[1]])


def _is_building(
    scenes: ComponentScenes, largest: SegmentRef, level: np.ndarray, metres: float, outline: Outline | None
) -> bool:
    """Return true if an object is a part of the building, by its segment with most samples."""
    capture = scenes.load(largest[0])
    heights = capture.points @ level[2] * metres
    points, lab = scenes.samples(largest)
    floor_m, ceiling_m = np.quantile(heights, _FLOOR_AND_CEILING).tolist()
    return is_building_part(points @ level.T * metres, lab, floor_m, ceiling_m, outline)


def _sorted(objects: list[MapObject]) -> list[MapObject]:
    """Return the objects, the largest first, and after them parts of the building, with unique ids."""
    objects.sort(key=lambda obj: (obj.is_building, -float(np.prod(obj.box[1] - obj.box[0])), obj.id))
    taken: set[str] = set()
    out = []
    for obj in objects:
        name = obj.id
        while name in taken:
            name = text_digest(name)[:8]
        taken.add(name)
        out.append(obj if name == obj.id else replace(obj, id=name))
    return out

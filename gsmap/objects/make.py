"""Construct the objects of the map from the segments of its scenes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmap import render as rendering
from gsmap.geometry.directions import level_frame
from gsmap.methods import RecipeKey, text_digest
from gsmap.objects.building_parts import is_building_part
from gsmap.objects.fuse import PlacedSegments, SegmentId, fuse
from gsmap.objects.visibility import LONGEST_SIDE_PX, MAX_VIEWS, RenderedViews, classify_observation, observe_points
from gsmap.types import MapObject, ObjectObservation, ObservationState, Segments, Sim3
from gsmap.types.plain import plain
from gsmap.types.progress import Progress, silent

VERSION = 2
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


def recipe_key(params: Params | None = None) -> RecipeKey:
    """Return the recipe of the objects of a component, without its inputs."""
    return RecipeKey("objects", "fused", {"objects": VERSION}, plain(params or Params()), rendering.backend())


@dataclass(frozen=True, eq=False)
class SegmentedScene:
    """A scene with a pose and segments.

    Args:
        scene: id of the scene.
        S_map_scene: pose of the scene.
        segments: segments of its scene graph.
    """

    scene: str
    S_map_scene: Sim3
    segments: Segments


def make_objects(
    captures: Sequence[SegmentedScene],
    component: int,
    render: Callable[[SegmentedScene], RenderedViews],
    *,
    metres: float = 1.0,
    up: np.ndarray | None = None,
    moved: Sequence[tuple[SegmentId, SegmentId]] = (),
    parted: Sequence[tuple[SegmentId, int]] = (),
    find_earlier: Callable[[int, SegmentId], tuple[ObservationState, float] | None] = lambda capture, node: None,
    in_frustum: Callable[[SegmentedScene, np.ndarray], bool] = lambda capture, points: True,
    params: Params | None = None,
    progress: Progress = silent,
) -> list[MapObject]:
    """Construct the objects of one component of the map, the largest first, and after them parts of the building.

    A scene is rendered at most once, and only if an object of other scenes lies in the frustum of its cameras. So the
    cost of a scene depends only on its own segments and on the objects at its place.

    Args:
        captures: scenes of the component, oldest first.
        render: function that renders the views of a scene; it is called at most once for each scene.
        metres: metres per unit of the map.
        up: (3,) direction against gravity in the map frame; default: z.
        moved: pairs of segments, by index, of one moved object.
        parted: pairs of a segment and the index of a scene that does not show the segment in place.
        find_earlier: function that returns, from an earlier run, the state and observed fraction of a segment of
            another scene in a scene (by index); None if it has to be observed now.
        in_frustum: function that returns whether a camera of a scene has any of the points (scene frame and unit) in
            its frustum.
        params: see `Params`.
        progress: called with the fraction done in [0, 1] and the current step.
    """
    params = params or Params()
    if not captures:
        return []
    placed = [_placed(capture, metres) for capture in captures]
    groups = fuse(placed, moved, parted, params.min_overlap)
    gone = set(parted)
    kept = []
    for group in groups:
        rows = {c: np.flatnonzero(placed[c].segments == t) for c, t in group}
        places = {c: (placed[c].points[mine] / metres, placed[c].lab[mine]) for c, mine in rows.items()}
        members = max(np.count_nonzero(captures[c].segments.members == t) for c, t in group)
        if members >= params.min_gaussians:
            kept.append((group, places))
    sightings: list[dict[int, ObjectObservation]] = [
        {
            c: ObjectObservation(captures[c].scene, "seen", t, np.array([at[c][0].min(0), at[c][0].max(0)]))
            for c, t in group
        }
        for group, at in kept
    ]
    for c, capture in enumerate(captures):
        progress(c / max(len(captures), 1), f"observing {len(kept)} objects in scene {c + 1} of {len(captures)}")
        # The scene nearest in time provides the expected place of each object.
        of = [min((o for o in at if o != c), key=lambda o: (abs(o - c), o), default=c) for _, at in kept]
        points = [places[o][0] for (_, places), o in zip(kept, of, strict=True)]
        S_scene_map, unit = capture.S_map_scene.inverse(), metres * capture.S_map_scene.scale
        results: dict[int, tuple[ObservationState, float]] = {}
        to_observe = []
        for i, mine in enumerate(sightings):
            if c in mine:
                continue
            before = find_earlier(c, (of[i], sightings[i][of[i]].thing))
            if before is not None:
                results[i] = before
            elif in_frustum(capture, S_scene_map.apply(points[i])):
                to_observe.append(i)
            else:
                sightings[i][c] = ObjectObservation(capture.scene, "unseen", -1, None, 0.0)
        if to_observe:
            seen = render(capture)
            own = [places[o][1] for (_, places), o in zip(kept, of, strict=True)]
            # Estimate exposure from objects that the scene certainly shows or, without any, from all objects with a
            # surface in place.
            sure = [i for i, mine in enumerate(sightings) if c in mine] or to_observe
            observations = {
                i: observe_points(seen, S_scene_map.apply(points[i]), unit) for i in dict.fromkeys([*sure, *to_observe])
            }
            off = np.concatenate([(observations[i].colours - own[i])[observations[i].on] for i in sure])
            shift = np.median(off, axis=0) if len(off) else np.zeros(3)
            for i in to_observe:
                results[i] = classify_observation(observations[i], points[i] * metres, own[i], shift)
        for i, (state, share) in results.items():
            observed_at = captures[of[i]].scene
            if any((node, c) in gone for node in kept[i][0]):
                state, observed_at = "absent", ""  # a review may revert it, so it is not kept as an observation
            box = np.array([points[i].min(0), points[i].max(0)]) if state == "seen" else None
            sightings[i][c] = ObjectObservation(capture.scene, state, -1, box, share, observed_at)
    is_building = _building_parts(placed, [group for group, _ in kept], up)
    objects = []
    for (group, _), mine, of_building in zip(kept, sightings, is_building, strict=True):
        first, last = group[0], group[-1]
        own = captures[first[0]].segments.positions[first[1]] * captures[first[0]].segments.unit_m
        name = text_digest(f"{captures[first[0]].scene} {np.round(own, 1).tolist()}")[:8]
        box = mine[last[0]].box
        assert box is not None
        middle = captures[last[0]].S_map_scene.apply(captures[last[0]].segments.positions[last[1]][None])[0]
        colour = captures[last[0]].segments.colours[last[1]]
        observed = tuple(mine[c] for c in range(len(captures)))
        objects.append(MapObject(name, component, box, middle, colour, observed, is_building=of_building))
    objects.sort(key=lambda obj: (obj.is_building, -float(np.prod(obj.box[1] - obj.box[0])), obj.id))
    return _distinct(objects)


def _building_parts(
    placed: Sequence[PlacedSegments], groups: Sequence[tuple[SegmentId, ...]], up: np.ndarray | None
) -> list[bool]:
    """Return whether each group of segments is a part of the building, by its segment with most samples."""
    level = np.eye(3) if up is None else level_frame(up)
    points = [capture.points @ level.T for capture in placed]
    ends = [np.quantile(one[:, 2], _FLOOR_AND_CEILING) if len(one) else np.zeros(2) for one in points]
    out = []
    for group in groups:
        rows = {c: np.flatnonzero(placed[c].segments == t) for c, t in group}
        c = max(rows, key=lambda one: len(rows[one]))
        out.append(is_building_part(points[c][rows[c]], placed[c].lab[rows[c]], *ends[c].tolist()))
    return out


def _placed(capture: SegmentedScene, metres: float) -> PlacedSegments:
    """Return the sample points of every segment, in metres of the map."""
    segments = capture.segments
    points = capture.S_map_scene.apply(segments.samples) * metres
    return PlacedSegments(
        points, np.repeat(np.arange(len(segments)), segments.sample_counts), segments.sample_colours, len(segments)
    )


def _distinct(objects: list[MapObject]) -> list[MapObject]:
    """Make ids unique if two objects have the same id by chance."""
    taken: set[str] = set()
    out = []
    for obj in objects:
        name = obj.id
        while name in taken:
            name = text_digest(name)[:8]
        taken.add(name)
        out.append(obj if name == obj.id else replace(obj, id=name))
    return out

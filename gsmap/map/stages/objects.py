"""Object stage: load or compute the objects of each component."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.errors import NotFoundError
from gsmap.geometry.boxes import box_corners
from gsmap.geometry.directions import level_frame
from gsmap.geometry.transforms import transform_gaussians
from gsmap.map.date_filter import parse_moment
from gsmap.map.metric_scales import map_metres
from gsmap.map.settings import Settings
from gsmap.map.snapshot_read import snapshot_read
from gsmap.map.visits import MAX_SHIFT_M
from gsmap.methods import RecipeKey, text_digest
from gsmap.objects import (
    RenderedViews,
    SegmentedScene,
    find_changed_segment,
    find_rooms,
    is_in_view,
    make_objects,
    recipe_key,
    render_views,
)
from gsmap.objects.fuse import SegmentId
from gsmap.store import Store
from gsmap.store.objects import ObjectBoxes, ObjectSet
from gsmap.texts import few
from gsmap.types import Gaussians, ObservationState, PoseGraph, Room, Scene, SceneGraph, Segments, Sim3
from gsmap.types.progress import Progress, StageProgress


@dataclass(frozen=True, eq=False)
class ComponentObjects:
    """The objects of one component.

    Args:
        made: new objects without numbers, or the stored ones.
        places: extents of each new object per scene; None for stored objects.
        key: key under which to store new objects; None if they are not to be stored.
    """

    component: int
    made: ObjectSet
    places: Sequence[ObjectBoxes] | None
    key: RecipeKey | None


@snapshot_read
def objects_of_components(
    store: Store,
    settings: Settings,
    progress: StageProgress,
    graphs: Mapping[str, SceneGraph] | None,
    *,
    make: bool = True,
) -> tuple[PoseGraph, dict[str, Scene], dict[int, float], list[ComponentObjects], list[str]]:
    """Return the newest poses, the placed scenes, the metres per unit, the objects of each component, and notes."""
    placed = store.revisions.get()
    if placed is None:
        raise NotFoundError(
            "the map has no poses yet, so objects cannot be associated: run gsmap update",
            code="no_poses",
        )
    scenes = {scene.id: scene for scene in store.scenes.list() if scene.id in placed.poses}
    metres = {component: one.metres_per_unit for component, one in map_metres(store, placed).items()}
    described = {graph.scene: graph.key for graph in store.graphs.list()}  # the newest of each
    without = [scene.name for scene in scenes.values() if scene.id not in described] if graphs is None else []
    mine: dict[int, list[Scene]] = {}
    for scene in sorted(scenes.values(), key=_when):
        if scene.id in (described if graphs is None else graphs):
            mine.setdefault(placed.poses[scene.id].component, []).append(scene)
    sets = store.objects.sets() if graphs is None else []
    parts, given = [], set[str]()
    for i, component in enumerate(sorted(mine)):

        def told(fraction: float, text: str, part: int = i) -> None:
            progress("objects", (part + fraction) / len(mine), text)

        unit = metres[component]
        key = _key(store, settings, mine[component], described, unit) if graphs is None else None
        poses = {scene.id: placed.poses[scene.id].S_map_scene for scene in mine[component]}
        kept = None if key is None else next((one for one in sets if one.key == key.digest), None)
        still = {} if kept is None else _unmoved(kept.poses, poses, scenes, unit)
        if kept is not None and still.keys() == poses.keys():
            parts.append(ComponentObjects(component, kept, None, None))
            given |= {thing.id for thing in kept.objects}
        elif not make:
            raise NotFoundError("the objects of the map are out of date: run gsmap graph MAP", code="objects_outdated")
        else:
            read = (
                graphs if graphs is not None else {scene.id: store.graphs.load(scene.id) for scene in mine[component]}
            )
            parts.append(_made(store, settings, component, poses, scenes, read, unit, key, sets, told))
        without += [scenes[scene].name for scene, digest in parts[-1].made.things.items() if not digest]
    notes = []
    if without:
        notes.append(f"no segments of {few(without)}: run gsmap describe MAP SCENE with describe.things switched on")
    thinned = {scene.name: scene.thinning for scene in scenes.values() if scene.thinning is not None}
    if thinned:
        notes.append(
            f"{few(list(thinned))} {'is' if len(thinned) == 1 else 'are'} thinned: their segments are kept, "
            "and their earlier observations of other objects; they are not searched again"
        )
    outdated = [
        f"{scenes[one.older].name}:{scenes[one.newer].name}"
        for one in store.changes.current()
        if one.changes and not one.whole and one.older in scenes and one.newer in scenes
    ]
    if outdated:
        notes.append(
            f"changes of {few(outdated)} are not used, because one of their captures was ingested again: run gsmap "
            "changes MAP, which compares them again"
        )
    undated = [scene.name for scene in scenes.values() if scene.captured_at is None]
    if undated and len(scenes) > 1:
        notes.append(
            f"{len(undated)} of {len(scenes)} captures have no date: they come last, and half-lives leave them out"
        )
    return placed, scenes, metres, parts, notes


def _key(
    store: Store, settings: Settings, captures: Sequence[Scene], described: Mapping[str, str], unit: float
) -> RecipeKey:
    """Return the key of a component's objects, without reading arrays."""
    ids = {scene.id for scene in captures}
    told = [
        f"{one.key} {one.created_at} {[change.status == 'rejected' for change in one.changes]}"
        for one in store.changes.current()
        if one.changes and one.whole and {one.older, one.newer} <= ids
    ]
    seen = [f"{scene.id} {described[scene.id]}" for scene in captures]
    return recipe_key(settings.objects).of(*seen, f"metres {unit!r}", *told)


def _unmoved(
    then: Mapping[str, Sim3], now: Mapping[str, Sim3], scenes: Mapping[str, Scene], unit: float
) -> dict[str, Sim3]:
    """Return the current poses of scenes that moved less than the threshold for visits."""
    out = {}
    for scene, pose in now.items():
        if scene in then:
            corners = box_corners(scenes[scene].bounds)
            off = np.linalg.norm(pose.apply(corners) - then[scene].apply(corners), axis=1).max() * unit
            if off <= MAX_SHIFT_M:
                out[scene] = pose
    return out


def _made(
    store: Store,
    settings: Settings,
    component: int,
    poses: Mapping[str, Sim3],
    scenes: Mapping[str, Scene],
    graphs: Mapping[str, SceneGraph | None],
    unit: float,
    key: RecipeKey | None,
    sets: Sequence[ObjectSet],
    told: Progress,
) -> ComponentObjects:
    """Compute the objects of a component, reusing earlier observations that are still valid.

    Args:
        poses: ``S_map_scene`` of its scenes, oldest first.
        key: None if scenes are not rendered to look for objects of other scenes.
    """
    things = {
        scene: graph.segments for scene in poses if (graph := graphs[scene]) is not None and graph.segments is not None
    }
    captures = [SegmentedScene(scene, poses[scene], mine) for scene, mine in things.items()]
    digests = {scene: _digest(things[scene]) if scene in things else "" for scene in poses}
    before: dict[tuple[str, str, int], tuple[ObservationState, float]] = {}
    for old in sets:
        if key is None or old.recipe != key.recipe or old.metres != unit:
            continue
        still = _unmoved(old.poses, poses, scenes, unit)
        for thing in old.objects:
            shown = {sighting.scene: sighting.thing for sighting in thing.sightings}
            for one in thing.sightings:
                same = old.things.get(one.asked, "") == digests.get(one.asked)
                if one.asked in still and one.scene in still and same:
                    before[one.scene, one.asked, shown[one.asked]] = one.state, one.looked

    def looked(capture: int, node: SegmentId) -> tuple[ObservationState, float] | None:
        return before.get((captures[capture].scene, captures[node[0]].scene, node[1]))

    def could_see(capture: SegmentedScene, points: np.ndarray) -> bool:
        if key is None or scenes[capture.scene].thinning is not None:
            return False  # what is left of it does not show what it looked at
        return is_in_view(store.scenes.cameras(capture.scene), points, settings.objects.max_views)

    def eyes(capture: SegmentedScene) -> RenderedViews:
        gaussians, cameras = store.scenes.gaussians(capture.scene), store.scenes.cameras(capture.scene)
        return render_views(gaussians, cameras, settings.objects.max_views, settings.objects.longest_side_px)

    up = np.array([0.0, 0, 1])
    known = {scene: graph for scene in poses if (graph := graphs[scene]) is not None}
    ups = [poses[scene].rotation @ graph.up for scene, graph in known.items() if graph.up is not None]
    if ups and np.linalg.norm(np.sum(ups, axis=0)) > 0:
        up = np.sum(ups, axis=0) / np.linalg.norm(np.sum(ups, axis=0))
    moved, parted = _told(store, captures)
    objects = make_objects(
        captures,
        component,
        eyes,
        metres=unit,
        up=up,
        moved=moved,
        parted=parted,
        find_earlier=looked,
        in_frustum=could_see,
        params=settings.objects,
        progress=told,
    )
    places = [
        {one.scene: things[one.scene].extents[one.thing] for one in thing.sightings if one.thing >= 0}
        for thing in objects
    ]
    rooms = list[Room]()
    if key is not None:
        told(1.0, "rooms")
        rooms = _rooms(store, settings, poses, up, unit)
    names = ("", "") if key is None else (key.digest, key.recipe)
    return ComponentObjects(
        component, ObjectSet(*names, unit, dict(poses), digests, tuple(objects), up, tuple(rooms)), places, key
    )


_SHAPE = ("means", "quats", "log_scales", "logit_opacities")


def _rooms(store: Store, settings: Settings, poses: Mapping[str, Sim3], up: np.ndarray, unit: float) -> list[Room]:
    """Return the rooms in the level frame of ``up``, in metres, without rendering.

    Args:
        unit: metres per map unit.
    """
    S_level_map = Sim3(level_frame(up), np.zeros(3), unit)
    captures, eyes = [], [np.zeros((0, 3))]
    for scene, pose in poses.items():
        S = S_level_map @ pose
        source, cameras = store.scenes.source(scene), store.scenes.cameras(scene)
        columns = {name: np.concatenate(list(source.columns(name))) for name in _SHAPE}
        sh = np.zeros((len(columns["means"]), 1, 3), np.float32)
        captures.append(transform_gaussians(Gaussians(**columns, sh=sh), S))
        if not cameras.synthesised:
            eyes.append(S.apply(cameras.centers))
    return find_rooms(captures, np.concatenate(eyes), settings.objects.min_room_area_m2)


def _digest(things: Segments) -> str:
    return text_digest(things.extents.tobytes().hex())


def _when(scene: Scene) -> tuple[bool, float, str]:
    """Return a sort key: dated scenes by date, then undated scenes by arrival."""
    if scene.captured_at is None:
        return True, 0.0, scene.ingested_at or ""
    return False, parse_moment(scene.captured_at).timestamp(), scene.ingested_at or ""


def _told(
    store: Store, captures: Sequence[SegmentedScene]
) -> tuple[list[tuple[SegmentId, SegmentId]], list[tuple[SegmentId, int]]]:
    """Return object identities from changes that were not rejected.

    Returns:
        Things that are one though they moved; and things, each with a capture that does not show it where it stood.
    """
    at = {capture.scene: i for i, capture in enumerate(captures)}
    moved: list[tuple[SegmentId, SegmentId]] = []
    parted: list[tuple[SegmentId, int]] = []
    for comparison in store.changes.current():
        if comparison.older not in at or comparison.newer not in at:
            continue
        if not comparison.changes or not comparison.whole:
            continue
        older, newer = at[comparison.older], at[comparison.newer]
        found = store.changes.load(comparison.number).changes
        for change, kept in zip(found, comparison.changes, strict=True):
            if kept.status == "rejected" or kept.kind not in ("appeared", "disappeared", "replaced", "moved"):
                continue
            before = older, find_changed_segment(captures[older].segments.members, change.before)
            after = newer, find_changed_segment(captures[newer].segments.members, change.after)
            if before[1] >= 0:
                parted.append((before, newer))
            if after[1] >= 0:
                parted.append((after, older))
            if kept.kind == "moved" and before[1] >= 0 and after[1] >= 0:
                moved.append((before, after))
    return moved, parted

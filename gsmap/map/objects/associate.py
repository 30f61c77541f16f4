"""Object stage: load the objects of each component, or bring them up to date."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from gsmap.errors import NotFoundError
from gsmap.map.date_filter import capture_time
from gsmap.map.metric_scales import map_metres
from gsmap.map.objects.component_objects import Component, unmoved_poses, update_component
from gsmap.map.settings import Settings
from gsmap.map.snapshot_read import snapshot_read
from gsmap.methods import RecipeKey
from gsmap.objects import recipe_key
from gsmap.store import Store
from gsmap.store.change_rows import Comparison
from gsmap.store.objects import ObjectBoxes, ObjectSet
from gsmap.texts import few
from gsmap.types import PoseGraph, Scene, SceneGraph
from gsmap.types.progress import StageProgress


@dataclass(frozen=True, eq=False)
class ComponentObjects:
    """The objects of one component.

    Args:
        made: new objects without numbers, or the stored ones.
        places: extents of each new object per scene, and None for each object that keeps its number; None for stored
            objects.
        key: key under which to store new objects; None if they are not to be stored.
    """

    component: int
    made: ObjectSet
    places: Sequence[ObjectBoxes | None] | None
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
    for scene in sorted(scenes.values(), key=lambda scene: capture_time(scene.captured_at, scene.ingested_at)):
        if scene.id in (described if graphs is None else graphs):
            mine.setdefault(placed.poses[scene.id].component, []).append(scene)
    sets = store.objects.sets() if graphs is None else []
    component_of = {scene: pose.component for scene, pose in placed.poses.items()}
    compared: dict[int, list[Comparison]] = {}
    for one in store.changes.current():
        component = component_of.get(one.older)
        if one.changes and one.whole and component is not None and component == component_of.get(one.newer):
            compared.setdefault(component, []).append(one)
    parts = []
    for i, component in enumerate(sorted(mine)):

        def told(fraction: float, text: str, part: int = i) -> None:
            progress("objects", (part + fraction) / len(mine), text)

        unit = metres[component]
        told_of = compared.get(component, [])
        key = _key(settings, mine[component], described, unit, told_of) if graphs is None else None
        poses = {scene.id: placed.poses[scene.id].S_map_scene for scene in mine[component]}
        kept = None if key is None else next((one for one in sets if one.key == key.digest), None)
        still = {} if kept is None else unmoved_poses(kept.poses, poses, scenes, unit)
        if kept is not None and still.keys() == poses.keys():
            parts.append(ComponentObjects(component, kept, None, None))
        elif not make:
            raise NotFoundError("the objects of the map are out of date: run gsmap graph MAP", code="objects_outdated")
        else:
            wanted = Component(
                component,
                {scene.id: scene for scene in mine[component]},
                poses,
                {} if graphs is not None else {scene: described[scene] for scene in poses},
                unit,
                told_of,
                graphs,
            )
            made, places = update_component(store, settings, wanted, key, sets, told)
            parts.append(ComponentObjects(component, made, places, key))
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
    settings: Settings,
    captures: Sequence[Scene],
    described: Mapping[str, str],
    unit: float,
    compared: Sequence[Comparison],
) -> RecipeKey:
    """Return the key of a component's objects, without reading arrays."""
    told = [f"{one.key} {one.created_at} {[change.status == 'rejected' for change in one.changes]}" for one in compared]
    seen = [f"{scene.id} {described[scene.id]}" for scene in captures]
    return recipe_key(settings.objects).of(*seen, f"metres {unit!r}", *told)

"""Describe stage: compute the scene graphs that are missing for the current recipe."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import closing, nullcontext
from dataclasses import replace
from typing import TypeVar

from gsmap.describe import recipe_key
from gsmap.engine import run_jobs
from gsmap.map import models
from gsmap.map.jobs import describe_scene
from gsmap.map.settings import Settings
from gsmap.map.shared_jobs import SharedJobs, note_interruption
from gsmap.methods import RecipeKey
from gsmap.render import backend
from gsmap.store import Store
from gsmap.store.scenes import SceneSummary
from gsmap.types import Scene
from gsmap.types.progress import StageProgress

AnyScene = TypeVar("AnyScene", Scene, SceneSummary)


def graph_keys(store: Store, scenes: Sequence[AnyScene], settings: Settings) -> dict[str, RecipeKey]:
    """Return the key of each scene's graph by scene id; content and scale policy are its inputs."""
    recipe = recipe_key(settings.describe, models.specs(store))
    return {scene.id: recipe.of(scene.id, scene.scale_policy) for scene in scenes}


def without_graph(store: Store, keys: Mapping[str, RecipeKey]) -> list[str]:
    """Return the ids of scenes without a graph under their key, in the order of the keys, without reading arrays."""
    present = store.graphs.stored_keys(keys.values())
    return [scene for scene, key in keys.items() if key.digest not in present]


def unthinned(scenes: Sequence[AnyScene]) -> list[AnyScene]:
    """Return the scenes that are described by default, which are all but the thinned scenes."""
    return [scene for scene in scenes if scene.thinning is None]


def describe(
    store: Store, scenes: Sequence[AnyScene], settings: Settings, progress: StageProgress, *, verify: bool = False
) -> dict[str, RecipeKey]:
    """Compute the missing graphs; return the key of each scene's graph, except of quarantined scenes.

    Args:
        verify: read stored graphs, repeat damaged ones and retry quarantined ones.
    """
    keys: dict[str, RecipeKey] = graph_keys(store, scenes, settings)
    damaged: set[str] = store.graphs.damaged(keys.values()) if verify else set()
    if verify:
        store.prepared_scenes.forget_damaged(keys)
    lacking = {*without_graph(store, keys), *(scene for scene, key in keys.items() if key.digest in damaged)}
    missing = [scene for scene in scenes if scene.id in lacking]
    specs = models.specs(store)
    # A worker elsewhere must not choose another renderer than the one that the key names.
    rendered_by = backend(settings.describe.object.render_backend)
    params = replace(settings.describe, object=replace(settings.describe.object, render_backend=rendered_by))
    names = {keys[scene.id].digest: scene.name for scene in missing}

    def done(wanted: Collection[str]) -> set[str]:
        return store.graphs.stored_keys(wanted) - store.graphs.damaged(damaged.intersection(wanted))

    about = {keys[scene.id].digest: (scene.id,) for scene in missing}
    there = len(scenes) - len(missing)
    from gsmap.register.recipe import prepared_key  # imports the registration, which reading a map does not need

    with store.arrays.inbox() if missing else nullcontext("") as inbox:
        jobs = {keys[s.id].digest: (store.location, s.id, specs, params, keys[s.id], inbox) for s in missing}
        shared = SharedJobs(store, "describe", "graph", jobs, about, done, progress, again=verify)
        results = shared.results(lambda arguments: run_jobs(describe_scene, arguments, settings.engine))
        kept = note_interruption(lambda: f"{there + shared.num_kept()} of {len(scenes)} scenes are described and kept")
        with kept, closing(results):
            for key, (graph, prepared) in results:
                (scene,) = about[key]
                with store.transaction():
                    num_nodes = store.graphs.save(graph, keys[scene])
                    if prepared is not None:
                        store.prepared_scenes.save(prepared, prepared_key().of(scene, key))
                shared.saved(key, f"{names[key]}: {num_nodes} nodes")
    if verify:  # those of other recipes cannot be made again, and nothing needs them any more
        others = [graph.key for graph in store.graphs.list() if graph.scene in keys]
        if beyond_help := store.graphs.damaged(others):
            store.graphs.forget(beyond_help)
    return {scene: key for scene, key in keys.items() if f"graph {key.digest}" not in store.quarantine.encountered}

"""What to do next: what a map lacks, what other settings or versions made, and what wants a person."""

from __future__ import annotations

from collections.abc import Sequence

from gsmap.map.settings import Settings
from gsmap.map.stages.describe import graph_keys
from gsmap.map.stages.export import dirty_tiles
from gsmap.map.stages.optimize import is_solved, pose_inputs
from gsmap.map.stages.register import stale
from gsmap.store import Store
from gsmap.types import Scene
from gsmap.types.rows import MapStatus, TodoRow


def status(store: Store, settings: Settings) -> MapStatus:
    """``gsmap status MAP``, from the catalog alone: no array is read, nothing is computed."""
    at = store.folder
    scenes = store.scenes.list()
    graph = store.revisions.get()
    todo: list[TodoRow] = []

    def add(what: str, count: int, verb: str, meaning: str) -> None:
        if count:
            todo.append(TodoRow(what=what, count=count, verb=verb, meaning=meaning))

    keys = graph_keys(store, scenes, settings)
    described = {stored.scene for stored in store.graphs.list()}
    lacking = [scene for scene in scenes if store.graphs.find(keys[scene.id]) is None]
    bare = [scene for scene in lacking if scene.id not in described]
    add("undescribed", len(bare), f"gsmap update {at}", "scenes without a graph")
    add(
        "stale_graphs",
        len(lacking) - len(bare),
        f"gsmap update {at}",
        "graphs made by other settings or another version",
    )
    registered = {
        scene for r in store.registrations.current() for scene in (r.registration.target, r.registration.source)
    }
    alone = [scene for scene in scenes if scene.id not in registered]
    add(
        "unregistered",
        len(alone) if len(scenes) > 1 else 0,
        f"gsmap update {at}",
        "scenes that were never tried with another",
    )
    add("stale_edges", len(stale(store, settings)), f"gsmap update {at}", "edges made by other settings or versions")
    if scenes and not is_solved(store, settings):
        revisions = store.revisions.list()
        same_inputs = bool(revisions) and revisions[-1].recipe == pose_inputs(store, settings).key.recipe
        if revisions and not same_inputs:
            add("stale_poses", 1, f"gsmap optimize {at}", "poses solved by other settings or another version")
        else:
            add("unsolved", 1, f"gsmap optimize {at}", "scenes, edges, reviews or priors newer than the poses")
    for target, count in dirty_tiles(store, settings).items():
        add("dirty_tiles", count, f"gsmap export {at} {target}", f"tiles in {target} that are out of date")
    poses = [pose for scene, pose in (graph.poses if graph else {}).items() if scene in keys]
    tentative = [pose for pose in poses if pose.status == "tentative"]
    add("tentative", len(tentative), f"gsmap list {at} scenes --status tentative", "scenes on edges no cycle confirms")
    undecided = [pair for pair in (graph.undecided if graph else ()) if set(pair) <= set(keys)]
    add("undecided", len(undecided), f"gsmap list {at} edges", "edges that nothing could decide: confirm or reject")
    outweighed = graph.provenance.contradicted_priors if graph else ()
    add("contradicted_priors", len(outweighed), f"gsmap prior {at} SCENE", "priors that the edges outweigh")
    isolated = [pose for pose in poses if pose.status == "isolated"]
    add("isolated", len(isolated), f"gsmap list {at} scenes --status isolated", "scenes that nothing ties to others")
    components = len({pose.component for pose in poses})
    return MapStatus(
        todo=tuple(todo),
        scenes=len(scenes),
        components=components,
        islands=components,
        tentative=len(tentative),
        revision=store.revisions.current(),
        metres_per_unit=_metres_per_unit(scenes),
    )


def _metres_per_unit(scenes: Sequence[Scene]) -> float | None:
    """1 where some scene is known to be in metres, since known scales fix the map's; else nobody knows."""
    return 1.0 if any(scene.scale_policy == "known" for scene in scenes) else None

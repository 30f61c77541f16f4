"""What a map lacks, what is stale, and what wants a person."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product

import numpy as np

from gsmap.map.settings import Settings
from gsmap.map.stages.describe import graph_keys
from gsmap.map.stages.optimize import pose_inputs
from gsmap.map.stages.register import stale
from gsmap.optimize import moved
from gsmap.store import Store
from gsmap.types import PoseGraph, Scene, Tile
from gsmap.types.rows import MapStatus, TodoRow


def status(store: Store, settings: Settings) -> MapStatus:
    """What to do next, most urgent first, each with the verb that helps. Reads the catalog only, no arrays."""
    scenes, placed = store.scenes.list(), store.revisions.get()
    poses = {scene.id: placed.poses[scene.id] for scene in scenes if placed and scene.id in placed.poses}
    todo = [
        *_undescribed(store, scenes, settings),
        *_unregistered(store, scenes, settings),
        *_unsolved(store, settings),
        *(_wants_a_person(store, placed, {scene.id: scene.name for scene in scenes}) if placed else ()),
        *(_dirty_tiles(store, placed, settings) if placed else ()),
    ]
    components = len({pose.component for pose in poses.values()})
    known = {scene.id for scene in scenes if scene.scale_policy == "known"}
    return MapStatus(
        todo=tuple(todo),
        scenes=len(scenes),
        components=components,
        islands=components,
        tentative=sum(pose.status == "tentative" for pose in poses.values()),
        revision=store.revisions.current(),
        metres_per_unit=1.0 if any(scene in known and poses[scene].component == 0 for scene in poses) else None,
    )


def _todo(what: str, count: int, verb: str, meaning: str) -> list[TodoRow]:
    return [TodoRow(what=what, count=count, verb=verb, meaning=meaning)] if count else []


def _undescribed(store: Store, scenes: list[Scene], settings: Settings) -> list[TodoRow]:
    keys = graph_keys(store, scenes, settings)
    have = {graph.scene for graph in store.graphs.list()}
    lacking = [scene for scene in scenes if scene.id not in have]
    old = [scene for scene in scenes if scene.id in have and store.graphs.find(keys[scene.id]) is None]
    verb = f"gsmap describe {store.folder}"
    return [
        *_todo("undescribed", len(lacking), verb, "scenes without a scene graph"),
        *_todo("stale_graphs", len(old), verb, "scene graphs made by other settings or another version"),
    ]


def _unregistered(store: Store, scenes: list[Scene], settings: Settings) -> list[TodoRow]:
    tried = {scene for r in store.registrations.current() for scene in (r.registration.target, r.registration.source)}
    alone = [scene for scene in scenes if scene.id not in tried] if len(scenes) > 1 else []
    verb = f"gsmap register {store.folder}"
    return [
        *_todo("unregistered", len(alone), verb, "scenes that were never tried with another one"),
        *_todo("stale_edges", len(stale(store, settings)), verb, "edges made by other settings or another version"),
    ]


def _unsolved(store: Store, settings: Settings) -> list[TodoRow]:
    revisions, inputs = store.revisions.list(), pose_inputs(store, settings)
    if not inputs.scenes:
        return []
    verb = f"gsmap optimize {store.folder}"
    if not revisions:
        return _todo("unsolved", 1, verb, "scenes have no poses yet")
    newest = revisions[-1]
    if newest.key == inputs.key.digest:
        return []
    if newest.recipe != inputs.key.recipe:
        return _todo("stale_poses", 1, verb, "poses solved with other settings or another version")
    pairs = [(r.registration.target, r.registration.source) for r in store.registrations.current()]
    said = [
        word for pair in pairs for word in store.registrations.reviews(*pair) if word.created_at > newest.created_at
    ]
    return [
        *_todo("unsolved_reviews", len(said), verb, "reviews that the poses do not know of yet"),
        *_todo("unsolved", int(not said), verb, "scenes, edges or priors that the poses do not know of yet"),
    ]


def _wants_a_person(store: Store, placed: PoseGraph, names: Mapping[str, str]) -> list[TodoRow]:
    poses = [pose for scene, pose in placed.poses.items() if scene in names]
    undecided = [f"{names[a]}:{names[b]}" for a, b in placed.undecided if a in names and b in names]
    weak = [
        f"{names[a]}:{names[b]}" for (a, b), o in placed.outcomes.items() if o.use == "tentative" and {a, b} <= {*names}
    ]
    outweighed = [scene for scene in placed.provenance.contradicted_priors if scene in names]
    tentative = sum(pose.status == "tentative" for pose in poses)
    isolated = sum(pose.status == "isolated" for pose in poses) if len(poses) > 1 else 0
    folder = store.folder
    return [
        *_todo(
            "undecided",
            len(undecided),
            f"gsmap confirm (or reject) {folder} {undecided[0] if undecided else ''}",
            "edges that another group of edges contradicts",
        ),
        *_todo(
            "tentative",
            tentative,
            f"gsmap confirm (or reject) {folder} {weak[0] if weak else 'A:B'}",
            "scenes that rest on edges which no cycle confirms",
        ),
        *_todo(
            "contradicted_priors",
            len(outweighed),
            f"gsmap show {folder} {names[outweighed[0]] if outweighed else ''}",
            "scenes whose prior the edges outweigh",
        ),
        *_todo("isolated", isolated, f"gsmap list {folder} edges", "scenes that nothing ties to another one"),
    ]


def _dirty_tiles(store: Store, placed: PoseGraph, settings: Settings) -> list[TodoRow]:
    """Tiles whose scenes moved, went or came; exports that name a revision are left as they are."""
    scenes = {scene.id: scene for scene in store.scenes.list() if scene.id in placed.poses}
    pinned = {export.target for export in store.exports.list() if export.settings.get("revision") is not None}
    out = []
    for target in store.exports.targets():
        if target not in pinned:
            tiles = [tile for tile in store.exports.tiles(target) if _is_dirty(tile, scenes, placed, settings)]
            verb = f"gsmap export {store.folder} {target}"
            out += _todo("dirty_tiles", len(tiles), verb, f"tiles of {target} whose scenes moved, went or came")
    return out


def _is_dirty(tile: Tile, scenes: Mapping[str, Scene], placed: PoseGraph, settings: Settings) -> bool:
    for scene, made_with in tile.poses.items():
        if scene not in scenes or placed.poses[scene].component != tile.component:
            return True
        if moved(made_with, placed.poses[scene].S_map_scene, settings.export.moved_m, _corners(scenes[scene])):
            return True
    return any(_reaches(scenes[scene], placed, tile) for scene in scenes if scene not in tile.poses)


def _reaches(scene: Scene, placed: PoseGraph, tile: Tile) -> bool:
    """Whether a scene that is not in a tile lies in it by its middle: its border may touch many a tile in vain."""
    pose = placed.poses[scene.id]
    middle = pose.S_map_scene.apply(scene.bounds.mean(0))
    return pose.component == tile.component and bool(((middle >= tile.bounds[0]) & (middle < tile.bounds[1])).all())


def _corners(scene: Scene) -> np.ndarray:
    return np.array(list(product(*scene.bounds.T)))

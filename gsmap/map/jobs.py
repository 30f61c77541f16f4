"""What a worker runs: a scene described, a pair registered or compared. Each opens the map to read, returns types."""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import lru_cache

from gsmap import change as changing
from gsmap import describe as describing
from gsmap import register as registering
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.register import SceneView
from gsmap.store import Store, branches, homes, sqlite
from gsmap.types import ChangeReport, PlacedScene, Registration, SceneGraph, Sim3
from gsmap.types.model import ModelSpec


def _store(path: str) -> Store:
    """The map at a path, kept open for the jobs to come."""
    return _opened(*_catalog_file(path))


@lru_cache(maxsize=1)
def _opened(location: str, inode: int) -> Store:
    return Store.open(location, "r")


def _catalog_file(path: str) -> tuple[str, int]:
    """The absolute location of a map, and which file its catalog is: where jobs run in a person's own process, another
    map may come to lie at the same path. (A file that is held open keeps its inode to itself.)"""
    location = path if homes.is_remote(path) else os.path.abspath(path)
    try:
        return location, (branches.find(location).folder / sqlite.FILE).stat().st_ino
    except FileNotFoundError:  # its catalog is a database elsewhere
        return location, 0


@lru_cache(maxsize=4)
def _view(path: str, scene_id: str, graph_key: str) -> SceneView:
    """Pairs come ordered by scene, so a few views kept save most of the reading; the key names their content."""
    store = _store(path)
    scenes, graphs = store.scenes, store.graphs
    graph = graphs.load(scene_id, graph_key)
    assert graph is not None, f"scene {scene_id} was to be registered before it was described"
    policy = scenes.get(scene_id).scale_policy
    return SceneView(scene_id, scenes.gaussians(scene_id), scenes.cameras(scene_id), graph, policy)


def describe_scene(path: str, scene_id: str, models: Mapping[str, ModelSpec], params: describing.Params) -> SceneGraph:
    """The graph of one scene of the map at ``path`` (`Store.location`)."""
    scenes = _store(path).scenes
    policy = scenes.get(scene_id).scale_policy
    gaussians, cameras = scenes.gaussians(scene_id), scenes.cameras(scene_id)
    return describing.describe(scene_id, gaussians, cameras, params, models, scale_policy=policy)


def register_scenes(
    path: str, target: tuple[str, str], source: tuple[str, str], params: registering.Params
) -> Registration:
    """The registration of one pair of the map at ``path``; target and source are (scene id, key of its graph)."""
    return registering.register_pair(_view(path, *target), _view(path, *source), params)


def compare_scenes(
    path: str, older: tuple[str, Sim3, str], newer: tuple[str, Sim3, str], params: changing.Params
) -> ChangeReport:
    """What changed between two scenes of the map at ``path``; each is (scene id, S_map_scene, captured at)."""
    return changing.compare(_placed(path, *older), _placed(path, *newer), params)


def _placed(path: str, scene_id: str, S_map_scene: Sim3, captured_at: str) -> PlacedScene:
    scenes = _store(path).scenes
    gaussians, cameras = scenes.gaussians(scene_id), scenes.cameras(scene_id)
    return PlacedScene(
        transform_gaussians(gaussians, S_map_scene), transform_cameras(cameras, S_map_scene), scene_id, captured_at
    )

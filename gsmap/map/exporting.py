"""Exporting: which scenes, with which poses, merged how; the tiles themselves are `gsmap.export` and `gsmap.merge`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.errors import ConfigError, InputError, NotFoundError
from gsmap.export import ExportResult, Params, PlannedTile, TileRecipe, export_tiles, plan_tiles
from gsmap.export.tileset import FILE_NAME, write_tilesets
from gsmap.merge import Params as MergeParams
from gsmap.merge import reach_m, recipe_key, uses_dates, with_steps
from gsmap.merge.tile import LazyScene, merge_tile
from gsmap.store import Store
from gsmap.types import MergeResult, Scene, ScenePose, Tile
from gsmap.types.progress import Progress


@dataclass(frozen=True)
class Request:
    """What is asked of an export; see `gsmap.Map.export`.

    Args:
        merge: the merger; None takes the one of the settings.
        steps: optimisation steps per tile; None takes what the merger's settings say.
    """

    format: str = "ply"
    tile_size_m: float = 10.0
    bbox: Sequence[float] | None = None
    merge: str | None = None
    revision: int | None = None
    component: int | None = None
    steps: int | None = None
    budget_s: float | None = None
    provenance: bool = False


def export(
    store: Store,
    out: Path,
    request: Request,
    progress: Progress,
    merging: MergeParams | None = None,
    params: Params | None = None,
) -> ExportResult:
    """Plan the tiles, make the dirty ones, write them, and note in the store what was made from what."""
    merging, params = merging or MergeParams(), params or Params()
    method = request.merge or merging.method
    how = merging.mergers[method]
    if request.steps is not None:
        how = with_steps(method, how, request.steps)
    recipe = TileRecipe(recipe_key(method, how), request.format, request.provenance, request.budget_s)
    _check(request, recipe)
    revision = request.revision or store.revisions.current()
    placed = _placed(store, revision, request.component)
    scenes = {scene: store.scenes.get(scene) for scene in placed}
    if uses_dates(method, how):
        recipe = recipe.with_dates({scene: found.captured_at for scene, found in scenes.items()})
    plan = plan_tiles(
        {scene: pose.S_map_scene for scene, pose in placed.items()},
        {scene: found.bounds for scene, found in scenes.items()},
        tile_size_m=request.tile_size_m,
        components={scene: pose.component for scene, pose in placed.items()},
        bbox=None if request.bbox is None else np.reshape(np.asarray(request.bbox, float), (2, 3)),
        reach_m=reach_m(method, how),
        max_tiles=params.max_tiles,
    )
    settings = {**asdict(request), "bbox": None if request.bbox is None else list(request.bbox), "merge": method}
    number: list[int] = []

    def noted(tile: Tile) -> None:
        if not tile.path:  # nothing lies there
            return
        if not number:
            number.append(store.exports.begin(out, revision=revision, settings=settings))
        store.exports.add_tile(number[0], tile)

    make = partial(_make, store, scenes, request, method, how)
    result = export_tiles(plan, make, out, map_id=store.id, recipe=recipe, params=params, made=noted, progress=progress)
    if recipe.is_tileset and (result.recomputed or result.removed or not list(out.glob(f"*/{FILE_NAME}"))):
        write_tilesets(out, result.tiles, request.tile_size_m)
    kept = {tile.path for tile in result.tiles}
    gone = [tile.path for tile in store.exports.tiles(out) if tile.path not in kept]
    if gone:
        store.exports.forget(out, gone)
    return result


def _check(request: Request, recipe: TileRecipe) -> None:
    """Refuse what makes no sense before anything is read."""
    if request.budget_s is not None and not request.budget_s > 0:
        raise ConfigError(f"the budget must be a positive number of seconds, got {request.budget_s}")
    if recipe.is_tileset and not request.tile_size_m > 0:
        raise ConfigError("3dtiles is a tree of tiles: give --tile-size in metres, or use glb for one file")


def _placed(store: Store, revision: int | None, component: int | None) -> dict[str, ScenePose]:
    """The poses of the scenes to export."""
    graph = store.revisions.get(revision)
    if graph is None:
        raise NotFoundError("the map has no poses yet: run gsmap update or gsmap optimize first")
    living = {s.id for s in store.scenes.list()} if revision == store.revisions.current() else set(graph.poses)
    placed = {s: p for s, p in graph.poses.items() if s in living}
    if component is not None:
        placed = {s: p for s, p in placed.items() if p.component == component}
        if not placed:
            known = sorted({p.component for p in graph.poses.values()})
            raise NotFoundError(f"revision {revision} has no component {component}: it has {known}")
    if not placed:
        raise InputError("nothing to export: no scene has a place in the map yet; run gsmap update first")
    return placed


def _make(
    store: Store,
    scenes: dict[str, Scene],
    request: Request,
    method: str,
    params: Any,
    tile: PlannedTile,
    progress: Progress,
) -> MergeResult:
    """The merged content of one tile."""
    lazy = [
        LazyScene(
            scene,
            pose,
            partial(store.scenes.gaussians, scene),
            store.scenes.cameras(scene),
            scenes[scene].captured_at,
        )
        for scene, pose in tile.poses.items()
    ]
    bounds = None if request.tile_size_m == 0 and request.bbox is None else tile.bounds
    return merge_tile(lazy, method, params, bounds=bounds, budget_s=request.budget_s, progress=progress)

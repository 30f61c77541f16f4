"""Exporting: which scenes, with which poses, merged how; the tiles themselves are `gsmap.export` and `gsmap.merge`."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gsmap import formats
from gsmap.errors import ConfigError, InputError, NotFoundError
from gsmap.export import ExportResult, PlannedTile, export_tiles, plan_tiles
from gsmap.export.tileset import FILE_NAME, write_tilesets
from gsmap.formats import tiles3d
from gsmap.merge import MergeResult, default_params, methods, reach_m
from gsmap.merge.tile import Source, merge_tile
from gsmap.store import Store
from gsmap.types import Scene, ScenePose, Tile


@dataclass(frozen=True)
class Request:
    """What is asked of an export; see `gsmap.Map.export`."""

    format: str = "ply"
    tile_size_m: float = 10.0
    bbox: Sequence[float] | None = None
    merge: str = "tto"
    revision: int | None = None
    component: int | None = None
    steps: int | None = None
    budget_s: float | None = None
    provenance: bool = False


def export(store: Store, out: Path, request: Request, progress: Callable[[float, str], None]) -> ExportResult:
    """Plan the tiles, make the dirty ones, write them, and note in the store what was made from what."""
    _check(request)
    params = _params(request)
    revision = request.revision or store.revisions.current()
    placed = _placed(store, revision, request.component)
    scenes = {scene: store.scenes.get(scene) for scene in placed}
    plan = plan_tiles(
        {scene: pose.S_map_scene for scene, pose in placed.items()},
        {scene: found.bounds for scene, found in scenes.items()},
        tile_size_m=request.tile_size_m,
        components={scene: pose.component for scene, pose in placed.items()},
        bbox=None if request.bbox is None else np.reshape(np.asarray(request.bbox, float), (2, 3)),
        reach_m=reach_m(request.merge, params),
    )
    settings = {**asdict(request), "bbox": None if request.bbox is None else list(request.bbox)}
    number: list[int] = []

    def noted(tile: Tile, made: MergeResult) -> None:
        if not tile.path:  # nothing lies there
            return
        if not number:
            number.append(store.exports.begin(out, revision=revision, settings=settings))
        store.exports.add_tile(number[0], tile)

    result = export_tiles(
        plan,
        partial(_make, store, scenes, request, params),
        out,
        map_id=store.id,
        method=f"{request.merge} {json.dumps([asdict(params), request.budget_s, request.provenance])}",
        format="glb" if request.format == "3dtiles" else request.format,
        write=_writer(request, scenes),
        made=noted,
        progress=progress,
    )
    if request.format == "3dtiles" and (result.recomputed or result.removed or not list(out.glob(f"*/{FILE_NAME}"))):
        write_tilesets(out, result.tiles, request.tile_size_m)
    kept = {tile.path for tile in result.tiles}
    gone = [tile.path for tile in store.exports.tiles(out) if tile.path not in kept]
    if gone:
        store.exports.forget(out, gone)
    return result


def _check(request: Request) -> None:
    """Refuse what makes no sense before anything is read."""
    if request.budget_s is not None and not request.budget_s > 0:
        raise ConfigError(f"the budget must be a positive number of seconds, got {request.budget_s}")
    if request.format == "3dtiles" and not request.tile_size_m > 0:
        raise ConfigError("3dtiles is a tree of tiles: give --tile-size in metres, or use glb for one file")
    if request.provenance and request.format != "ply":
        raise ConfigError(f"provenance is a property of .ply files, the format asked for is {request.format}")


def _params(request: Request) -> Any:
    """The merger's parameters with what was asked for put in."""
    if request.merge not in methods():
        raise ConfigError(f"unknown merge method {request.merge!r}: choose one of {', '.join(methods())}")
    params: Any = default_params(request.merge)
    if request.steps is None:
        return params
    if not hasattr(params, "steps"):
        raise ConfigError(f"merge method {request.merge!r} takes no steps: leave --steps out, or use tto")
    if request.steps < 0:
        raise ConfigError(f"steps must not be negative, got {request.steps}")
    return replace(params, steps=request.steps)


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
            raise NotFoundError(f"revision {revision} has no island {component}: it has {known}")
    if not placed:
        raise InputError("nothing to export: no scene has a place in the map yet; run gsmap update first")
    return placed


def _make(
    store: Store,
    scenes: dict[str, Scene],
    request: Request,
    params: Any,
    tile: PlannedTile,
    progress: Callable[[float, str], None],
) -> MergeResult:
    """The merged content of one tile."""
    sources = [
        Source(
            scene,
            pose,
            partial(store.scenes.gaussians, scene),
            store.scenes.cameras(scene),
            scenes[scene].captured_at,
        )
        for scene, pose in tile.poses.items()
    ]
    bounds = None if request.tile_size_m == 0 and request.bbox is None else tile.bounds
    return merge_tile(sources, request.merge, params, bounds=bounds, budget_s=request.budget_s, progress=progress)


def _writer(request: Request, scenes: dict[str, Scene]) -> Callable[[Path, MergeResult], None] | None:
    """How a tile's file is written, where it is not just its Gaussians."""
    if request.format == "3dtiles":
        return _write_content
    if not request.provenance:
        return None
    return lambda path, made: formats.write(path, made.gaussians, extra={"scene": made.origin.astype(np.float32)})


def _write_content(path: Path, made: MergeResult) -> None:
    tiles3d.write_content(path, made.gaussians)

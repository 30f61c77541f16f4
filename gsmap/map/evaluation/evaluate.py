"""Evaluate a map against ground truth: load the data, and compute the metrics with `gsmap.evaluate`."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from gsmap import formats
from gsmap.errors import MALFORMED, InputError, NotFoundError
from gsmap.evaluate.images import Lpips
from gsmap.evaluate.map_errors import EvaluatedScene, Params, evaluate_map
from gsmap.evaluate.overlap import solid_centres, true_overlaps
from gsmap.evaluate.registration import scene_centroid
from gsmap.evaluate.renders import compare_renders, find_images
from gsmap.export import manifest, tileset
from gsmap.export.manifest import Manifest
from gsmap.export.recipe import upright_back
from gsmap.formats import tiles3d
from gsmap.geometry.boxes import box_corners
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.map import reports
from gsmap.store import Store
from gsmap.types import Cameras, Gaussians, Scene, ScenePose, Sim3, Tile
from gsmap.types.metric_scale import MetricScale
from gsmap.types.model import ModelLimits
from gsmap.types.progress import Progress
from gsmap.types.rows.evaluation import EvaluationReport, ImageErrorRow

_TILES_KEPT = 8  # in memory at once, for the scene that has a part in them and the next one


def poses(
    store: Store,
    truth: str | os.PathLike[str],
    params: Params | None = None,
    metres: Mapping[int, MetricScale] | None = None,
) -> EvaluationReport:
    """Evaluate every accepted edge and the newest poses against ground truth.

    Args:
        truth: folder of ``NAME.json``, each with ``T_scene_world`` (4x4, a similarity): where the scene's frame lies;
            the world is in metres.
        metres: of every component of the newest poses; not judged where None.

    Raises:
        NotFoundError, InputError: no truth for any scene, or a file that holds none.
    """
    scenes = store.scenes.list()
    S_scene_world = {s.id: found for s in scenes if (found := _read_truth(Path(truth), s.name)) is not None}
    if not S_scene_world:
        raise NotFoundError(
            f"{truth} has no true pose of any scene: put a NAME.json with T_scene_world there for each scene",
            code="no_truth",
        )

    def judged(scene: Scene) -> EvaluatedScene:
        if scene.id not in S_scene_world:
            return EvaluatedScene(scene.id, scene.name, None, np.zeros(3), np.zeros((0, 3)))
        centroid, centers = scene_centroid(store.scenes.gaussians(scene.id)), store.scenes.cameras(scene.id).centers
        return EvaluatedScene(scene.id, scene.name, S_scene_world[scene.id], centroid, centers)

    params = params or Params()
    solid = partial(_solid, store, S_scene_world)
    with store.located():
        overlaps = true_overlaps(list(S_scene_world), solid)
        of_scenes = [judged(s) for s in scenes]
    edges, graph = reports.edge_rows(store), store.revisions.get()
    return evaluate_map(of_scenes, edges, graph, overlaps, params, metres)


def _solid(store: Store, S_scene_world: Mapping[str, Sim3], scene: str) -> np.ndarray:
    return solid_centres(store.scenes.gaussians(scene), S_scene_world[scene])


def _read_truth(folder: Path, name: str) -> Sim3 | None:
    if not folder.is_dir():
        raise NotFoundError(f"there is no folder of true poses at {folder}", code="folder_not_found")
    path = folder / f"{name}.json"
    if not path.exists():
        return None
    try:
        return Sim3.from_matrix(np.array(json.loads(path.read_text())["T_scene_world"], dtype=float))
    except (OSError, *MALFORMED) as error:
        raise InputError(f"{path} needs a T_scene_world, a 4x4 similarity: {error}", code="invalid_truth") from error


def images(
    store: Store,
    folder: str | os.PathLike[str],
    progress: Progress,
    *,
    tiles: str | os.PathLike[str] | None = None,
    lpips: str | os.PathLike[str] | None = None,
    limits: ModelLimits | None = None,
) -> tuple[ImageErrorRow, ...]:
    """Compare renders of each scene alone, of the union with its neighbours, and of exported tiles with its photos.

    What a photograph shows, its scene holds: so only what meets the scene is rendered, and the cost grows with the
    photographs, whatever the size of the map.

    Args:
        folder: of photographs named like the cameras (suffixes may differ), in a folder per scene where the scenes'
            cameras share names.
        tiles: folder that this map was exported to.
        lpips: an LPIPS network (`gsmap.evaluate.images.Lpips`) to compare with, too.
        limits: what that may take.

    Raises:
        NotFoundError: no photograph is named like a camera, or no export lies in ``tiles``.
        ConfigError, InputError: the export of another map, or one that lacks a file.
    """
    network = None if lpips is None else Lpips(Path(lpips), limits)
    exported = None if tiles is None else _Export(store, Path(tiles))
    scenes = store.scenes.list()
    union = _union_of(store, scenes)
    rows = []
    for i, scene in enumerate(scenes):
        progress(i / len(scenes), scene.name)
        cameras = store.scenes.cameras(scene.id)
        pictures = _pictures(scene, cameras, folder)
        if not pictures:
            continue

        def likeness(gaussians: Gaussians, S_map_scene: Sim3 | None = None) -> dict[str, float]:
            moved = cameras if S_map_scene is None else transform_cameras(cameras, S_map_scene)  # noqa: B023
            return compare_renders(gaussians, moved, pictures, lpips=network).means()  # noqa: B023

        own = store.scenes.gaussians(scene.id)
        alone = likeness(own)
        merged = union(scene)
        of_union = {} if merged is None else likeness(*merged)
        content = None if exported is None else exported.content(scene.id)
        of_tiles = {} if content is None else likeness(*content)
        cover = None if exported is None or content is None else exported.cover(scene.id, own)
        rows.append(
            ImageErrorRow(
                scene=scene.id,
                scene_name=scene.name,
                num_images=len(pictures),
                alone_psnr_db=alone["psnr_db"],
                alone_ssim=alone["ssim"],
                alone_lpips=alone.get("lpips"),
                union_psnr_db=of_union.get("psnr_db"),
                union_ssim=of_union.get("ssim"),
                union_lpips=of_union.get("lpips"),
                tiles_psnr_db=of_tiles.get("psnr_db"),
                tiles_ssim=of_tiles.get("ssim"),
                tiles_lpips=of_tiles.get("lpips"),
                tiles_cover=cover,
            )
        )
    if not rows:
        raise NotFoundError(f"no image in {folder} has the name of a scene's camera", code="image_not_found")
    progress(1.0, "")
    return tuple(rows)


def _union_of(store: Store, scenes: list[Scene]) -> Callable[[Scene], tuple[Gaussians, Sim3] | None]:
    """Return a function that computes the union of a scene with its overlapping neighbours, and the scene's pose in
    it.
    """
    graph = store.revisions.get()
    placed = {s.id: graph.poses[s.id] for s in scenes if graph is not None and s.id in graph.poses}
    boxes = {s.id: _map_box(s.bounds, placed[s.id]) for s in scenes if s.id in placed}

    def union(scene: Scene) -> tuple[Gaussians, Sim3] | None:
        if scene.id not in placed:
            return None
        here, (low, high) = placed[scene.id], boxes[scene.id]
        near = [
            pose
            for s, pose in placed.items()
            if pose.component == here.component and (boxes[s][0] <= high).all() and (boxes[s][1] >= low).all()
        ]
        parts = [transform_gaussians(store.scenes.gaussians(p.scene), p.S_map_scene) for p in near]
        return Gaussians.concatenate(parts), here.S_map_scene

    return union


def _map_box(bounds: np.ndarray, pose: ScenePose) -> np.ndarray:
    """Return the box (2, 3) of a scene in the map frame."""
    corners = pose.S_map_scene.apply(box_corners(bounds))
    return np.stack([corners.min(0), corners.max(0)])


class _Export:
    """The exported tiles of a map in a folder, by the scenes that contribute to them.

    Raises:
        NotFoundError: there is no export.
        ConfigError, InputError: it is another map's, or a tile's file is missing or was cut short.
    """

    def __init__(self, store: Store, folder: Path) -> None:
        if not (folder / manifest.FILE_NAME).is_file():
            raise NotFoundError(
                f"no {manifest.FILE_NAME} in {folder}: give a folder that gsmap export wrote", code="not_an_export"
            )
        found = Manifest.load(folder, store.id)
        self._folder = folder
        self._tiles: dict[str, list[Tile]] = {}
        for tile in found.tiles.values():
            if not found.has_file(folder, tile):
                raise InputError(
                    f"{folder / tile.path} is missing or cut short: run gsmap export to {folder} again",
                    code="export_damaged",
                )
            for scene in tile.poses:
                self._tiles.setdefault(scene, []).append(tile)
        asked = [export.settings for export in store.exports.list() if export.target == str(folder.resolve())]
        self._format = asked[-1].get("format") if asked else None
        self._read = lru_cache(_TILES_KEPT)(self._read_file)

    def content(self, scene: str) -> tuple[Gaussians, Sim3] | None:
        """Return all tiles of a scene, and the scene's pose at the time of the export; None without tiles."""
        tiles = [tile for tile in self._tiles.get(scene, []) if tile.path]
        if not tiles:
            return None
        # Tiles of one export may differ in the pose by what `export.max_shift_m` lets pass: the fullest one decides.
        fullest = max(tiles, key=lambda tile: tile.num_gaussians)
        return Gaussians.concatenate([self._read(tile.path, tile.up) for tile in tiles]), fullest.poses[scene]

    def cover(self, scene: str, gaussians: Gaussians, min_opacity: float = 0.3) -> float:
        """Return the fraction of a scene's opaque Gaussians that lie within its tiles."""
        opaque = gaussians.means[gaussians.opacities > min_opacity]
        inside = np.zeros(len(opaque), dtype=bool)
        for tile in self._tiles[scene]:
            moved = tile.poses[scene].apply(opaque)
            inside |= ((moved >= tile.bounds[0]) & (moved <= tile.bounds[1])).all(1)
        return float(inside.mean()) if len(opaque) else 0.0

    def _read_file(self, path: str, up: str) -> Gaussians:
        """Read a tile in the map frame."""
        file = self._folder / path
        is_tileset = (file.parent / tileset.FILE_NAME).exists() if self._format is None else self._format == "3dtiles"
        content = tiles3d.read_content(file) if is_tileset and file.suffix == ".glb" else formats.read(file)
        content = content.about(np.zeros(3))
        return upright_back(content) if up == "y" else content


def _pictures(scene: Scene, cameras: Cameras, folder: str | os.PathLike[str]) -> dict[int, Path]:
    """Return the photos of a scene by camera index, from a folder of the scene's name if one exists."""
    own = Path(folder) / scene.name
    try:
        return find_images(cameras, own if own.is_dir() else folder)
    except NotFoundError:
        if not Path(folder).is_dir():
            raise
        return {}

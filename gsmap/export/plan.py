"""Which tiles an export consists of."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.errors import ConfigError, InputError
from gsmap.types import Sim3


@dataclass(frozen=True)
class Params:
    """How a map is cut into tiles and kept up to date.

    Args:
        moved_m: a tile is made again when a scene moved farther than this within it.
        max_tiles: an export of more tiles than this is refused.
        shared_bytes: what renders of the captures, which tiles share while they are made, may take in the folder.
    """

    moved_m: float = 0.005
    max_tiles: int = 1_000_000
    shared_bytes: int = 4 << 30

    def __post_init__(self) -> None:
        if not self.moved_m >= 0:
            raise ConfigError(f"moved_m must not be negative, got {self.moved_m}")


@dataclass(frozen=True, eq=False)
class PlannedTile:
    """A tile to be exported.

    Args:
        component: the component it belongs to; each has its own frame and folder.
        name: of its file, without suffix; unique in its component.
        bounds: (2, 3) float64 box in the component's map frame.
        poses: ``S_map_scene`` by scene id, of every scene that may reach into it.
        extent: text that says which part of the map it is, however the scenes move.
        metres_per_unit: of the component's map frame.
    """

    component: int
    name: str
    bounds: np.ndarray
    poses: dict[str, Sim3]
    extent: str
    metres_per_unit: float = 1.0


def plan_tiles(
    poses: Mapping[str, Sim3],
    scene_bounds: Mapping[str, np.ndarray],
    *,
    tile_size_m: float,
    components: Mapping[str, int] | None = None,
    bbox: np.ndarray | None = None,
    reach_m: float = 0.0,
    metres_per_unit: Mapping[int, float] | None = None,
    max_tiles: int = Params.max_tiles,
) -> list[PlannedTile]:
    """Tiles of a grid through the map's origin that scenes reach into, in a fixed order.

    Args:
        poses: ``S_map_scene`` by scene id, of the scenes to export.
        scene_bounds: (2, 3) box of each scene's Gaussians in the scene's frame.
        tile_size_m: edge of a tile; 0 makes one tile of each component.
        components: component of each scene; all 0 if None.
        bbox: (2, 3) only this box of the map, in its unit as poses are; tiles are cut by it.
        reach_m: how far beyond its bounds a tile's content depends on scenes.
        metres_per_unit: of each component's frame; all 1 if None.
        max_tiles: more tiles than this are refused.

    Raises:
        ConfigError: a negative tile size, or one so small that there would be too many tiles.
        InputError: no scenes, an empty box, or a box that no scene touches.
    """
    if not (np.isfinite(tile_size_m) and tile_size_m >= 0):
        raise ConfigError(f"tile size must be a positive number of metres, or 0 for one file, got {tile_size_m}")
    if not poses:
        raise InputError("nothing to export: no scene has a place in the map yet; run optimize first")
    bbox = None if bbox is None else _checked_box(bbox)
    components = components or dict.fromkeys(poses, 0)
    tiles: list[PlannedTile] = []
    for component in sorted({components[s] for s in poses}):
        members = {s: _Box(poses[s], scene_bounds[s]) for s in sorted(poses) if components[s] == component}
        extent = _around([box.map_bounds for box in members.values()])
        if bbox is not None:
            extent = np.array([np.maximum(extent[0], bbox[0]), np.minimum(extent[1], bbox[1])])
            if not (extent[1] > extent[0]).all():
                continue
        metres = 1.0 if metres_per_unit is None else metres_per_unit[component]
        edge, reach = tile_size_m / metres, reach_m / metres
        cells: Sequence[tuple[int, int, int] | None] = [None]
        if tile_size_m:
            cells = _cells(extent * metres, tile_size_m, max_tiles)
        for cell in cells:
            if cell is None:
                bounds = extent if bbox is None else bbox
                name = "map"
            else:
                bounds = np.array([np.multiply(cell, edge), np.multiply(np.add(cell, 1), edge)])
                name = "tile_" + "_".join(f"{c:+04d}" for c in cell)
                if bbox is not None:
                    bounds = np.array([np.maximum(bounds[0], bbox[0]), np.minimum(bounds[1], bbox[1])])
            if not any(box.touches(bounds) for box in members.values()):
                continue
            near = np.array([bounds[0] - reach, bounds[1] + reach])
            touching = {s: poses[s] for s, box in members.items() if box.touches(near)}
            place = json.dumps([tile_size_m, cell, None if bbox is None else bbox.tolist()])
            tiles.append(PlannedTile(component, name, bounds, touching, place, metres))
    if not tiles and bbox is not None:
        whole = _around([_Box(poses[s], scene_bounds[s]).map_bounds for s in poses])
        raise InputError(
            f"the box {_text(bbox)} lies outside the map, which spans {_text(whole)}: choose a box that touches it"
        )
    return tiles


class _Box:
    """A scene's box of Gaussians, oriented as the scene lies in the map."""

    def __init__(self, S_map_scene: Sim3, bounds: np.ndarray) -> None:
        bounds = np.asarray(bounds, dtype=np.float64)
        self.half = S_map_scene.scale * (bounds[1] - bounds[0]) / 2
        self.center = S_map_scene.apply((bounds[0] + bounds[1]) / 2)
        self.axes = S_map_scene.rotation
        reach = np.abs(self.axes) @ self.half
        # A touch larger, so that Gaussians on the very border lie inside however their means round.
        pad = 1e-5 * (1 + np.abs(self.center).max() + reach.max())
        self.map_bounds = np.array([self.center - reach - pad, self.center + reach + pad])

    def touches(self, box: np.ndarray) -> bool:
        """Whether the oriented box meets an axis-aligned one, by the face normals of both (never a false no)."""
        if (self.map_bounds[0] > box[1]).any() or (self.map_bounds[1] < box[0]).any():
            return False
        offset = self.axes.T @ ((box[0] + box[1]) / 2 - self.center)
        return bool((np.abs(offset) <= self.half + np.abs(self.axes.T) @ ((box[1] - box[0]) / 2) + 1e-5).all())


def _cells(extent: np.ndarray, tile_size_m: float, max_tiles: int) -> list[tuple[int, int, int]]:
    with np.errstate(over="ignore", invalid="ignore"):
        low, high = np.floor(extent[0] / tile_size_m), np.ceil(extent[1] / tile_size_m)
        count = np.prod(high - low)
    if not count <= max_tiles:
        raise ConfigError(
            f"tiles of {tile_size_m} m would be {count:.3g} over {_text(extent)}: use larger tiles or a box"
        )
    first, last = low.astype(int), high.astype(int)
    return [
        (x, y, z) for x in range(first[0], last[0]) for y in range(first[1], last[1]) for z in range(first[2], last[2])
    ]


def _checked_box(bbox: np.ndarray) -> np.ndarray:
    bbox = np.asarray(bbox, dtype=np.float64)
    if bbox.shape != (2, 3) or not np.isfinite(bbox).all() or not (bbox[1] > bbox[0]).all():
        raise InputError(f"a box needs x0 y0 z0 below x1 y1 z1 on every axis, got {_text(bbox)}: it is empty")
    return bbox


def _around(boxes: list[np.ndarray]) -> np.ndarray:
    return np.array([np.min([b[0] for b in boxes], 0), np.max([b[1] for b in boxes], 0)])


def _text(box: np.ndarray) -> str:
    return " to ".join("(" + ", ".join(f"{v:.6g}" for v in np.atleast_1d(corner)) + ")" for corner in box)

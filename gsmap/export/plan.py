"""Plan the tiles of an export."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from gsmap.errors import ConfigError, InputError
from gsmap.export import levels
from gsmap.export.cells import CellSet, Grid, OrientedBoxes
from gsmap.geometry.origins import float32_step, origin_of
from gsmap.settings.ranges import require_range
from gsmap.types import Sim3

_MAX_ROUNDED_M = 1e-3
MAX_WHOLE_GAUSSIANS = 1_500_000
"""Largest number of Gaussians, of all captures of a component, that one file is made of: what viewers in a browser load
at once and a phone still draws (30 MB of SPZ, 160 MB of ``.ply``, at SH degree 1)."""
AUTO_TILE_M = 10.0  # edge of the tiles of a larger component


@dataclass(frozen=True)
class Params:
    """Settings of tiles and their levels of detail.

    Args:
        max_shift_m: Largest distance in metres, at least 0, by which a scene may have moved within a tile that is
            reused; larger reuses more tiles.
        max_tiles: Largest number of tiles of an export, at least 0, not counting tiles without a scene; an export with
            more tiles is refused, so larger permits larger exports.
        max_shared_bytes: Largest size in bytes, at least 0, of the renders that are stored in the folder during an
            export for use by several tiles; larger needs more disk and renders less often.
        levels: Settings of the coarser levels of 3D Tiles and streamed SOG.
    """

    max_shift_m: float = 0.005
    max_tiles: int = 1_000_000
    max_shared_bytes: int = 4 << 30
    levels: levels.Params = field(default_factory=levels.Params)

    def __post_init__(self) -> None:
        require_range(self, "[0, inf]", "max_tiles", "max_shared_bytes")
        require_range(self, "[0, inf]", "max_shift_m")


@dataclass(frozen=True, eq=False)
class PlannedTile:
    """A tile to be exported, with the scenes that may reach into it.

    Args:
        component: its component, each of which has its own frame and folder.
        name: name of its file, without suffix; unique in its component.
        bounds: (2, 3) float64 box in the component's map frame.
        poses: ``S_map_scene`` by scene id, of every scene that may reach into it.
        extent: text that identifies the part of the map, independent of the poses.
        metres_per_unit: metric scale of the component's map frame.
        is_cut: true if only content within the bounds belongs to it.
        num_input: number of Gaussians of its scenes within it, by the volumes of their boxes; for progress.
    """

    component: int
    name: str
    bounds: np.ndarray
    poses: dict[str, Sim3]
    extent: str
    metres_per_unit: float = 1.0
    is_cut: bool = True
    num_input: float = 1.0


def plan_tiles(
    poses: Mapping[str, Sim3],
    scene_bounds: Mapping[str, np.ndarray],
    *,
    tile_size_m: float | None,
    num_gaussians: Mapping[str, int] | None = None,
    components: Mapping[str, int] | None = None,
    bbox: np.ndarray | None = None,
    reach_m: float = 0.0,
    metres_per_unit: Mapping[int, float] | None = None,
    max_tiles: int = Params.max_tiles,
) -> list[PlannedTile]:
    """Plan the tiles of a grid that scenes reach into, in a fixed order.

    The map's z is up where gravity is known, so the grid is level. A grid of a given size begins at the map's origin.
    An automatic one is centred on it, so that it cuts no storey and no house near the first capture in two.

    Args:
        poses: ``S_map_scene`` by scene id, of the scenes to export.
        scene_bounds: (2, 3) box of each scene's Gaussians in the scene's frame.
        tile_size_m: edge of a tile; 0 makes one tile of each component; None makes one tile of a component of at most
            `MAX_WHOLE_GAUSSIANS`, and tiles of `AUTO_TILE_M` of a larger one.
        num_gaussians: number of Gaussians of each scene; without it none counts.
        components: component of each scene; all 0 if None.
        bbox: (2, 3) box in the map's unit that tiles are clipped to; None for all.
        reach_m: distance beyond its bounds within which scenes affect a tile.
        metres_per_unit: metric scale of each component; all 1 if None.
        max_tiles: largest number of tiles.

    Raises:
        ConfigError: a negative tile size, or one so small that there would be too many tiles.
        InputError: no scenes, an empty box, a box outside of all scenes, or a component so far from the origin that
            single precision does not resolve a millimetre.
    """
    if tile_size_m is not None and not (np.isfinite(tile_size_m) and tile_size_m >= 0):
        raise ConfigError(
            f"tile size must be a positive number of metres, or 0 for one file, got {tile_size_m}", code="out_of_range"
        )
    if not poses:
        raise InputError(
            "nothing to export: no scene has a pose yet; run gsmap optimize first", code="nothing_to_export"
        )
    bbox = None if bbox is None else _checked_box(bbox)
    components = components or dict.fromkeys(poses, 0)
    tiles: list[PlannedTile] = []
    for component in sorted({components[s] for s in poses}):
        members = [scene for scene in sorted(poses) if components[scene] == component]
        boxes = OrientedBoxes.of([poses[scene] for scene in members], [scene_bounds[scene] for scene in members])
        metres = 1.0 if metres_per_unit is None else metres_per_unit[component]
        _require_near(component, boxes.around, metres)
        reach = reach_m / metres
        counts = np.array([(num_gaussians or {}).get(scene, 0) for scene in members], dtype=np.float64)
        uncut = list(_in_one(boxes, bbox, reach))
        edge_m, centred = tile_size_m, False
        if edge_m is None:
            is_large = any(counts[rows].sum() > MAX_WHOLE_GAUSSIANS for _, _, rows in uncut)
            edge_m, centred = (AUTO_TILE_M, True) if is_large else (0.0, False)
        for cell, bounds, reaching in (
            _in_cells(boxes, Grid(edge_m / metres, bbox, max_tiles, centred), reach) if edge_m else uncut
        ):
            name = "map" if cell is None else "tile_" + "_".join(f"{c:+04d}" for c in cell)
            place = json.dumps([edge_m, cell, None if bbox is None else bbox.tolist(), *["centred"] * centred])
            near = {members[row]: poses[members[row]] for row in reaching}
            is_cut = cell is not None or bbox is not None
            num_input = boxes.share_within(reaching, bounds) @ counts[reaching] if num_gaussians else 1.0
            tiles.append(PlannedTile(component, name, bounds, near, place, metres, is_cut, float(num_input)))
    if not tiles and bbox is not None:
        whole = OrientedBoxes.of(list(poses.values()), [scene_bounds[scene] for scene in poses]).around
        raise InputError(
            f"the box {_text(bbox)} lies outside the map, which spans {_text(whole)}: choose a box that touches it",
            code="box_outside_map",
        )
    return tiles


def _require_near(component: int, box: np.ndarray, metres_per_unit: float) -> None:
    """Raise an error for a component so far from zero that single precision would round its Gaussians coarsely."""
    offset = origin_of(box)
    rounded_m = float32_step(box) / 2 * metres_per_unit
    if offset.any() and rounded_m > _MAX_ROUNDED_M:
        at = ", ".join(f"{value:.15g}" for value in offset)
        raise InputError(
            f"component {component} lies near ({at}), where single precision rounds by {rounded_m:.2g} m: subtract "
            f"({at}) from the positions of its priors (gsmap prior), or georeference it instead (gsmap georeference)",
            code="precision_loss",
        )


_Tiles = Iterator[tuple[tuple[int, ...] | None, np.ndarray, list[int]]]


def _in_one(boxes: OrientedBoxes, bbox: np.ndarray | None, reach: float) -> _Tiles:
    """Yield the whole component as one tile: None as cell, its bounds, and the rows of all boxes that reach into it."""
    bounds = boxes.around if bbox is None else bbox
    everyone = np.arange(len(boxes))
    low, high = (np.tile(corner, (len(boxes), 1)) for corner in bounds)
    if boxes.touch(everyone, low, high).any():
        yield None, bounds, np.flatnonzero(boxes.touch(everyone, low - reach, high + reach)).tolist()


def _in_cells(boxes: OrientedBoxes, grid: Grid, reach: float) -> _Tiles:
    """Yield each cell that a box intersects, in order, with its bounds and the rows of all boxes within reach."""
    which, cells = grid.reached(boxes)
    holding = CellSet.of(cells)
    if not len(holding):
        return
    if len(holding) > grid.most:
        raise grid.too_many(boxes)
    if reach > 0:
        which, cells = grid.reached(boxes, reach, holding)
    mine = holding.find(cells)
    order = np.lexsort((which, mine))
    rows = np.split(which[order], np.cumsum(np.bincount(mine, minlength=len(holding)))[:-1])
    low, high = grid.bounds(holding.cells, holding.cells + 1)
    for k, cell in enumerate(holding.cells.tolist()):
        yield tuple(cell), np.array([low[k], high[k]]), rows[k].tolist()


def _checked_box(bbox: np.ndarray) -> np.ndarray:
    bbox = np.asarray(bbox, dtype=np.float64)
    if bbox.shape != (2, 3) or not np.isfinite(bbox).all() or not (bbox[1] > bbox[0]).all():
        raise InputError(
            f"the box {_text(bbox)} is empty: x0 y0 z0 must be below x1 y1 z1 on every axis",
            code="invalid_box",
        )
    return bbox


def _text(box: np.ndarray) -> str:
    return " to ".join("(" + ", ".join(f"{v:.6g}" for v in np.atleast_1d(corner)) + ")" for corner in box)

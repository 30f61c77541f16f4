"""Make the levels of detail of a scene for viewing: a 3D Tiles tree, whose leaves have all Gaussians, and a sketch.

Stored Gaussians are ordered along a space-filling curve, so that each octree cell is a range of rows. The tree is built
in one pass from the leaves up; each level merges the Gaussians of a grid cell and keeps their moments
(`gsmap.geometry.voxels`). This takes one or two CPU seconds per million Gaussians; the pairwise merging of an export
(`gsmap.geometry.decimate`) takes five. Memory is bounded by eight tiles per level.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gsmap.errors import InputError
from gsmap.formats import tiles3d
from gsmap.formats.tiles3d import CONTENT_FOLDER, TileNode
from gsmap.geometry.boxes import box_around, robust_box
from gsmap.geometry.morton import BITS, morton_codes
from gsmap.geometry.voxels import axis_deviations, merge_groups, optical_depths, projected_areas
from gsmap.types import Gaussians, GaussianSource
from gsmap.types.progress import Progress

VERSION = 4
"""Version of trees and sketches; a new version invalidates cached ones."""

FILE_NAME = "tileset.json"
LEAST_OPACITY = 1 / 255  # opacity below which no renderer draws a Gaussian
_FANOUT = 8
_SIGMAS = 3.0
_STRAYS = 0.001  # fraction of the light of a tile beyond each side of its box
_STRAYS_OF_SCENE = 0.02  # fraction of the Gaussians of a scene beyond each side of its box
_EXTENT_ROWS = 2048  # maximum number of Gaussians by which the box of a tile is computed
_ERROR_QUANTILE = 0.95


@dataclass(frozen=True)
class TreeParams:
    """Sizes of the levels of detail of a scene.

    Args:
        leaf_gaussians: Maximum number of original Gaussians per tile; the average is about half.
        coarsening: Number of Gaussians merged into one between levels.
        root_gaussians: Maximum number of Gaussians of the coarsest level.
    """

    leaf_gaussians: int = 32_768
    coarsening: int = 8
    root_gaussians: int = 512


@dataclass(frozen=True, eq=False)
class Sketch:
    """A coarse approximation of a scene, with the scene's extent.

    Args:
        gaussians: Merged Gaussians of SH degree 0, scene frame.
        box: (2, 3) bounding box of the scene without floaters, scene frame.
    """

    gaussians: Gaussians
    box: np.ndarray


@dataclass(frozen=True, eq=False)
class _Cell:
    """A cell of the octree, which contains the rows ``[start, stop)``."""

    start: int
    stop: int
    children: tuple[_Cell, ...] = ()


@dataclass(frozen=True, eq=False)
class _Extent:
    """Lower and upper corners (K, 3) of sampled Gaussians below a tile, and the light (K,) that each sample represents.

    The weight is light, not number, because a viewer skips content outside the box: one large haze would be missed,
    a hundred small floaters would not.
    """

    low: np.ndarray
    high: np.ndarray
    weight: np.ndarray

    @classmethod
    def of(cls, gaussians: Gaussians) -> _Extent:
        reach = _SIGMAS * axis_deviations(gaussians)
        light = optical_depths(gaussians) * projected_areas(gaussians.scales) + 1e-30
        return cls(gaussians.means - reach, gaussians.means + reach, light).few()

    @classmethod
    def joined(cls, parts: list[_Extent]) -> _Extent:
        low, high, weight = (
            np.concatenate([getattr(part, name) for part in parts]) for name in ("low", "high", "weight")
        )
        return cls(low, high, weight).few()

    def few(self) -> _Extent:
        """Reduce the samples: keep the brightest, and some others with increased weights that represent the rest."""
        if len(self.weight) <= _EXTENT_ROWS:
            return self
        order = np.argsort(-self.weight, kind="stable")
        bright, rest = order[: _EXTENT_ROWS // 2], np.sort(order[_EXTENT_ROWS // 2 :])
        some = rest[:: -(-len(rest) // (_EXTENT_ROWS // 2))]
        share = self.weight[rest].sum() / self.weight[some].sum()
        rows = np.concatenate([bright, some])
        weight = np.concatenate([self.weight[bright], self.weight[some] * share])
        return _Extent(self.low[rows], self.high[rows], weight)

    def core(self) -> np.ndarray:
        """Return the box (2, 3) that contains all light except a small fraction on each side."""
        low, high = (robust_box(corners, self.weight, _STRAYS) for corners in (self.low, self.high))
        return np.stack([low[0], high[1]])

    def extras(self, content: Gaussians) -> dict[str, float]:
        """Return the extras of a tile: its number of Gaussians (cost) and its box without outliers (for distances)."""
        low, high = self.core().round(4).tolist()
        corners = zip(("core_x0", "core_y0", "core_z0", "core_x1", "core_y1", "core_z1"), (*low, *high), strict=True)
        return {"num_gaussians": len(content), **dict(corners)}


@dataclass(frozen=True, eq=False)
class _FinishedTile:
    """A tile whose file is written."""

    node: TileNode
    content: Gaussians
    extent: _Extent


def write_tree(
    folder: Path, source: GaussianSource, params: TreeParams | None = None, progress: Progress | None = None
) -> TileNode:
    """Write the tree of a scene into a new folder: ``tileset.json`` and its tiles.

    The name of each tile ends with the start of its digest.

    Args:
        source: along the Morton curve of its means (`gsmap.stream.sorted_along_morton_curve`), as scenes are stored.

    Returns:
        The root. Errors are how far, in the scene's unit, what a tile draws lies from the originals: what a twentieth
        of what it draws lies beyond.

    Raises:
        InputError: no Gaussian that can be seen.
    """
    params = params or TreeParams()
    (folder / CONTENT_FOLDER).mkdir(parents=True)
    builder = _Builder(folder, _Rows(source), params, progress or (lambda fraction, text: None), source.num_gaussians)
    made = builder.build(_octree(_codes(source), params.leaf_gaussians), "0")
    if made is None:
        raise InputError("the scene has no opaque Gaussians", code="no_opaque_gaussians")
    while len(made.content) > params.root_gaussians:
        made = builder.coarser([made], f"r{len(made.content)}", max(params.root_gaussians, 1))
    tiles3d.write_tileset(folder / FILE_NAME, made.node, transform=np.eye(4))
    return made.node


def sketch(source: GaussianSource, max_count: int) -> Sketch:
    """Approximate a scene by at most ``max_count`` Gaussians, merged from a sample of at least four times as many.

    Raises:
        InputError: The scene has no opaque Gaussians.
    """
    every = max(1, source.num_gaussians // max(4 * max_count, 8192))
    parts, at = [], 0
    for chunk in source.chunks():
        some = chunk[-at % every :: every]
        parts.append(shown(replace(some, sh=some.sh[:, :1])))
        at += len(chunk)
    found = Gaussians.concatenate(parts)
    if not len(found):
        raise InputError("the scene has no opaque Gaussians", code="no_opaque_gaussians")
    # Each remaining Gaussian is scaled to block as much light as those it represents.
    scales = found.log_scales + np.float32(np.log(every) / 2 if every > 1 else 0)
    box = robust_box(found.means, None, _STRAYS_OF_SCENE)
    return Sketch(_merged(replace(found, log_scales=scales), max_count)[0], box)


def shown(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians with finite values that are not transparent."""
    g = gaussians
    finite = np.isfinite(g.means).all(1) & np.isfinite(g.log_scales).all(1) & np.isfinite(g.quats).all(1)
    finite &= np.isfinite(g.sh).all((1, 2)) & (g.opacities > LEAST_OPACITY)
    return g if finite.all() else g[finite]


class _Rows:
    """A reader of the rows of a source in ascending order."""

    def __init__(self, source: GaussianSource) -> None:
        self._chunks: Iterator[Gaussians] = source.chunks()
        self._rest = Gaussians.empty(source.sh_degree)

    def take(self, count: int) -> Gaussians:
        parts, missing = [], count
        while missing:
            if not len(self._rest):
                self._rest = next(self._chunks)
            parts.append(self._rest[:missing])
            self._rest = self._rest[missing:]
            missing -= len(parts[-1])
        return Gaussians.concatenate(parts)


@dataclass(frozen=True, eq=False)
class _Builder:
    folder: Path
    rows: _Rows
    params: TreeParams
    progress: Callable[[float, str], None]
    num_gaussians: int

    def build(self, cell: _Cell, name: str) -> _FinishedTile | None:
        """Build the tile of a cell and all tiles below it; None if the cell has no opaque Gaussians."""
        if not cell.children:
            content = shown(self.rows.take(cell.stop - cell.start))
            self.progress(cell.stop / self.num_gaussians, "")
            if not len(content):
                return None
            extent = _Extent.of(content)
            uri, box = self._write(content, name)
            node = TileNode(box, 0.0, uri, extras=extent.extras(content))
            return _FinishedTile(node, content, extent)
        below = [self.build(child, f"{name}{i}") for i, child in enumerate(cell.children)]
        made = [one for one in below if one is not None]
        return self.coarser(made, name, 1) if made else None

    def coarser(self, below: list[_FinishedTile], name: str, least: int) -> _FinishedTile:
        """Build the tile that replaces its children at a distance."""
        finer = Gaussians.concatenate([one.content for one in below])
        level, error = _merged(finer, max(least, len(finer) // self.params.coarsening))
        extent = _Extent.joined([one.extent for one in below])
        error += max(one.node.error_m for one in below)
        # The box contains outliers, too, so that viewers do not cull visible content.
        uri, own = self._write(level, name)
        boxes = np.stack([own, *(one.node.box for one in below)])
        box = np.stack([boxes[:, 0].min(0), boxes[:, 1].max(0)])
        # A level without merged Gaussians must still count as coarser than its children.
        error = max(error, 1e-6 * float(np.linalg.norm(box[1] - box[0])))
        node = TileNode(box, error, uri, tuple(one.node for one in below), extent.extras(level))
        return _FinishedTile(node, level, extent)

    def _write(self, content: Gaussians, name: str) -> tuple[str, np.ndarray]:
        """Write the file of a tile; return its uri and the box (2, 3) of its content."""
        staged = self.folder / CONTENT_FOLDER / f"{name}.glb"
        tiles3d.write_content(staged, content)
        with open(staged, "rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        uri = f"{CONTENT_FOLDER}/{name}-{digest[:16]}.glb"
        staged.rename(self.folder / uri)
        return uri, tiles3d.box_of(content)


def _merged(gaussians: Gaussians, max_count: int) -> tuple[Gaussians, float]:
    """Merge the Gaussians in each cell of the finest grid that has at most ``max_count`` occupied cells.

    Returns the merged Gaussians, and the 95 % quantile of the distance from a Gaussian to its merged one.
    """
    if len(gaussians) <= max_count:
        return gaussians, 0.0
    codes = morton_codes(gaussians.means, box_around(gaussians.means))
    ordered = np.sort(codes)
    low, high = 0, 3 * BITS
    while low < high:  # find the smallest shift with few enough cells
        middle = (low + high) // 2
        if 1 + np.count_nonzero(np.diff(ordered >> np.uint64(middle))) <= max_count:
            high = middle
        else:
            low = middle + 1
    _, label = np.unique(codes >> np.uint64(low), return_inverse=True)
    level, _ = merge_groups(gaussians, label)
    apart = np.linalg.norm(gaussians.means - level.means[label], axis=1)
    return level, float(np.quantile(apart, _ERROR_QUANTILE))


def _codes(source: GaussianSource) -> np.ndarray:
    """Return ascending Morton codes (N,) uint64 of the rows."""
    means = np.concatenate(list(source.columns("means")))
    # Means of thinned scenes are rounded, so neighbours may be out of order.
    return np.maximum.accumulate(morton_codes(means, box_around(means)))


def _octree(codes: np.ndarray, max_leaf: int) -> _Cell:
    """Return an octree whose leaves have at most ``max_leaf`` rows."""

    def divide(start: int, stop: int, bit: int) -> _Cell:
        if stop - start <= max_leaf:
            return _Cell(start, stop)
        parts = [(start, stop, bit)]
        while len(parts) < _FANOUT:
            largest = max(range(len(parts)), key=lambda i: parts[i][1] - parts[i][0])
            if parts[largest][1] - parts[largest][0] <= max_leaf:
                break
            parts[largest : largest + 1] = _halves(codes, *parts[largest])
        return _Cell(start, stop, tuple(divide(*part) for part in parts))

    return divide(0, len(codes), 3 * BITS - 1)


def _halves(codes: np.ndarray, start: int, stop: int, bit: int) -> list[tuple[int, int, int]]:
    """Split the rows of a cell where their codes first differ, or in the middle if all are equal."""
    for at in range(bit, -1, -1):
        shift = np.uint64(at)
        boundary = ((codes[start] >> shift) | np.uint64(1)) << shift
        cut = start + int(np.searchsorted(codes[start:stop], boundary))
        if start < cut < stop:
            return [(start, cut, at - 1), (cut, stop, at - 1)]
    middle = (start + stop) // 2
    return [(start, middle, -1), (middle, stop, -1)]

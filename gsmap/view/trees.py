"""Levels of detail of one scene, for looking at it: a 3D Tiles tree whose leaves are its own Gaussians, and a sketch.

A scene lies in the store along a space-filling curve, so that every cell of an octree is a range of its rows. The tree
is made in one pass over them, from the leaves up, each level by merging what shares a cell of a grid, moments kept
(`gsmap.geometry.voxels`): a second or two of CPU a million, where the pairwise merging of an export
(`gsmap.geometry.decimate`) takes five. Memory is bounded by eight tiles a level.
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
"""Of what is made: another one makes all trees and sketches anew."""

FILE_NAME = "tileset.json"
LEAST_OPACITY = 1 / 255  # what no renderer draws
_FANOUT = 8
_SIGMAS = 3.0
_STRAYS = 0.001  # share of the light of a tile beyond a side of its box
_STRAYS_OF_SCENE = 0.02  # share of the Gaussians of a scene beyond a side of its box
_EXTENT_ROWS = 2048  # by which the box of a tile is found
_ERROR_QUANTILE = 0.95


@dataclass(frozen=True)
class TreeParams:
    """Sizes of the levels of detail of a scene.

    Args:
        leaf_gaussians: largest number of original Gaussians in one tile; about half as many on average.
        coarsening: number of Gaussians that become one from one level to the next.
        root_gaussians: largest number of Gaussians of the coarsest level.
    """

    leaf_gaussians: int = 32_768
    coarsening: int = 8
    root_gaussians: int = 512


@dataclass(frozen=True, eq=False)
class Sketch:
    """Coarse approximation of a scene, and its extent.

    Args:
        gaussians: a few, SH degree 0, scene frame.
        box: (2, 3) around what the scene shows, without floaters, scene frame.
    """

    gaussians: Gaussians
    box: np.ndarray


@dataclass(frozen=True, eq=False)
class _Cell:
    """A cell of the octree: rows ``[start, stop)``."""

    start: int
    stop: int
    children: tuple[_Cell, ...] = ()


@dataclass(frozen=True, eq=False)
class _Extent:
    """Lowest and highest corners (K, 3) of some of the Gaussians below a tile, and the light that each stands for (K,).

    Light, not number: what a viewer leaves out because it lies beyond a box must not be missed, and one large haze that
    reaches into the picture is, where a hundred specks that fly about are not.
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
        """The brightest as they are, and every few of the others, which stand for the rest."""
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
        """(2, 3) around all but the strays: a share of the light on every side."""
        low, high = (robust_box(corners, self.weight, _STRAYS) for corners in (self.low, self.high))
        return np.stack([low[0], high[1]])

    def extras(self, content: Gaussians) -> dict[str, float]:
        """Return the extras of a tile: how many Gaussians it draws, so that a viewer knows its cost before it loads
        it, and the box of what matters, from which its distance is taken."""
        low, high = self.core().round(4).tolist()
        corners = zip(("core_x0", "core_y0", "core_z0", "core_x1", "core_y1", "core_z1"), (*low, *high), strict=True)
        return {"num_gaussians": len(content), **dict(corners)}


@dataclass(frozen=True, eq=False)
class _FinishedTile:
    """A finished tile."""

    node: TileNode
    content: Gaussians
    extent: _Extent


def write_tree(
    folder: Path, source: GaussianSource, params: TreeParams | None = None, progress: Progress | None = None
) -> TileNode:
    """Write the tree of a scene into a folder that does not exist: ``tileset.json`` and the tiles that it names.

    Every tile's name ends with the beginning of the digest of its bytes.

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
        raise InputError("no Gaussian of it can be seen", code="no_opaque_gaussians")
    while len(made.content) > params.root_gaussians:
        made = builder.coarser([made], f"r{len(made.content)}", max(params.root_gaussians, 1))
    tiles3d.write_tileset(folder / FILE_NAME, made.node, transform=np.eye(4))
    return made.node


def sketch(source: GaussianSource, max_count: int) -> Sketch:
    """Approximate a scene coarsely from a sample of its Gaussians: at least four times as many as are requested.

    Raises:
        InputError: no Gaussian that can be seen.
    """
    every = max(1, source.num_gaussians // max(4 * max_count, 8192))
    parts, at = [], 0
    for chunk in source.chunks():
        some = chunk[-at % every :: every]
        parts.append(shown(replace(some, sh=some.sh[:, :1])))
        at += len(chunk)
    found = Gaussians.concatenate(parts)
    if not len(found):
        raise InputError("no Gaussian of it can be seen", code="no_opaque_gaussians")
    # Those that are left stand for the others: each stops as much light as all of them did.
    scales = found.log_scales + np.float32(np.log(every) / 2 if every > 1 else 0)
    box = robust_box(found.means, None, _STRAYS_OF_SCENE)
    return Sketch(_merged(replace(found, log_scales=scales), max_count)[0], box)


def shown(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians that are finite and not transparent."""
    g = gaussians
    finite = np.isfinite(g.means).all(1) & np.isfinite(g.log_scales).all(1) & np.isfinite(g.quats).all(1)
    finite &= np.isfinite(g.sh).all((1, 2)) & (g.opacities > LEAST_OPACITY)
    return g if finite.all() else g[finite]


class _Rows:
    """The rows of a source one after the other, as many as are asked for."""

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
        """The tile of a cell with all below it; None where nothing of it can be seen."""
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
        """The tile that is drawn in place of some."""
        finer = Gaussians.concatenate([one.content for one in below])
        level, error = _merged(finer, max(least, len(finer) // self.params.coarsening))
        extent = _Extent.joined([one.extent for one in below])
        error += max(one.node.error_m for one in below)
        # Whole, strays too: what is left out of a picture because its box is not in sight must not be missed.
        uri, own = self._write(level, name)
        boxes = np.stack([own, *(one.node.box for one in below)])
        box = np.stack([boxes[:, 0].min(0), boxes[:, 1].max(0)])
        # A level that nothing was merged for must still count as coarser than what it stands for.
        error = max(error, 1e-6 * float(np.linalg.norm(box[1] - box[0])))
        node = TileNode(box, error, uri, tuple(one.node for one in below), extent.extras(level))
        return _FinishedTile(node, level, extent)

    def _write(self, content: Gaussians, name: str) -> tuple[str, np.ndarray]:
        """Write the file of a tile; its uri, and the box (2, 3) of what it draws."""
        staged = self.folder / CONTENT_FOLDER / f"{name}.glb"
        tiles3d.write_content(staged, content)
        with open(staged, "rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        uri = f"{CONTENT_FOLDER}/{name}-{digest[:16]}.glb"
        staged.rename(self.folder / uri)
        return uri, tiles3d.box_of(content)


def _merged(gaussians: Gaussians, max_count: int) -> tuple[Gaussians, float]:
    """At most so many: those that share a cell of the finest grid that has no more of them; and the distance that a
    twentieth of the Gaussians lie beyond from the one that stands for them."""
    if len(gaussians) <= max_count:
        return gaussians, 0.0
    codes = morton_codes(gaussians.means, box_around(gaussians.means))
    ordered = np.sort(codes)
    low, high = 0, 3 * BITS
    while low < high:  # the least shift that leaves few enough
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
    """(N,) uint64 places along the curve, in ascending order."""
    means = np.concatenate(list(source.columns("means")))
    # A thinned scene's means are rounded, so that neighbours may have changed places.
    return np.maximum.accumulate(morton_codes(means, box_around(means)))


def _octree(codes: np.ndarray, max_leaf: int) -> _Cell:
    """Cells of which none without children has more than ``max_leaf`` rows."""

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
    """Rows of a cell divided where their codes first differ; in the middle where they are all one."""
    for at in range(bit, -1, -1):
        shift = np.uint64(at)
        boundary = ((codes[start] >> shift) | np.uint64(1)) << shift
        cut = start + int(np.searchsorted(codes[start:stop], boundary))
        if start < cut < stop:
            return [(start, cut, at - 1), (cut, stop, at - 1)]
    middle = (start + stop) // 2
    return [(start, middle, -1), (middle, stop, -1)]

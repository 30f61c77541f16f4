"""Intersect oriented boxes with the cells of a grid, in time that does not depend on empty space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.errors import ConfigError
from gsmap.types import Sim3

_FARTHEST = 2**40  # cells from the origin, beyond which cell numbers are not exact in float64


@dataclass(frozen=True, eq=False)
class OrientedBoxes:
    """B bounding boxes of scenes, oriented by their poses.

    Args:
        centers, halves: (B, 3) centres and half edges, map unit.
        axes: (B, 3, 3) rotations of the scenes.
        bounds: (B, 2, 3) axis-aligned boxes around them, padded so that Gaussians on the border lie inside despite
            rounding.
    """

    centers: np.ndarray
    halves: np.ndarray
    axes: np.ndarray
    bounds: np.ndarray

    @classmethod
    def of(cls, poses: Sequence[Sim3], scene_bounds: Sequence[np.ndarray]) -> OrientedBoxes:
        """Make boxes from the pose ``S_map_scene`` and the box (2, 3) of each scene in its scene frame."""
        count = len(poses)
        low, high = np.asarray(scene_bounds, dtype=np.float64).reshape(count, 2, 3).transpose(1, 0, 2)
        scales = np.array([pose.scale for pose in poses])[:, None]
        axes = np.array([pose.rotation for pose in poses]).reshape(count, 3, 3)
        halves = scales * (high - low) / 2
        centers = scales * np.einsum("bij,bj->bi", axes, (low + high) / 2)
        centers = centers + np.array([pose.translation for pose in poses]).reshape(count, 3)
        reach = np.einsum("bij,bj->bi", np.abs(axes), halves)
        pad = 1e-5 * (1 + np.abs(centers).max(1, initial=0) + reach.max(1, initial=0))[:, None]
        return cls(centers, halves, axes, np.stack([centers - reach - pad, centers + reach + pad], axis=1))

    def __len__(self) -> int:
        return len(self.centers)

    @property
    def around(self) -> np.ndarray:
        """Axis-aligned box (2, 3) around all boxes."""
        return np.array([self.bounds[:, 0].min(0), self.bounds[:, 1].max(0)])

    def share_within(self, which: Sequence[int], bounds: np.ndarray) -> np.ndarray:
        """Return for each of K boxes the fraction of its axis-aligned bounds that lies within the region (2, 3)."""
        low, high = self.bounds[which, 0], self.bounds[which, 1]
        shared = np.maximum(np.minimum(high, bounds[1]) - np.maximum(low, bounds[0]), 0)
        out: np.ndarray = (shared / (high - low)).prod(axis=1)
        return out

    def touch(self, which: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return a mask (K,) that is True where box ``which[k]`` intersects the box from ``low[k]`` to ``high[k]``.

        By the separating axes of the face normals, so that an intersection is never missed.
        """
        met = ((self.bounds[which, 0] <= high) & (self.bounds[which, 1] >= low)).all(1)
        near = np.flatnonzero(met)
        which, low, high = which[near], low[near], high[near]
        turned = self.axes[which]
        offset = np.einsum("kji,kj->ki", turned, (low + high) / 2 - self.centers[which])
        reach = self.halves[which] + np.einsum("kji,kj->ki", np.abs(turned), (high - low) / 2)
        met[near] = (np.abs(offset) <= reach + 1e-5).all(1)
        return met


@dataclass(frozen=True, eq=False)
class CellSet:
    """A set of grid cells, sorted by x, then y, then z.

    Args:
        cells: (K, 3) int64.
        values: sorted unique coordinates on each axis.
        keys: (K,) key of each cell, from the ranks of its coordinates.
    """

    cells: np.ndarray
    values: tuple[np.ndarray, ...]
    keys: np.ndarray

    @classmethod
    def of(cls, cells: np.ndarray) -> CellSet:
        values = tuple(np.unique(cells[:, axis]) for axis in range(3))
        keys, first = np.unique(_key(values, cells)[0], return_index=True)
        return cls(cells[first], values, keys)

    def __len__(self) -> int:
        return len(self.keys)

    def find(self, cells: np.ndarray) -> np.ndarray:
        """Return the index (K,) in the set of each cell (K, 3); -1 for cells outside the set."""
        keys, known = _key(self.values, cells)
        places = np.minimum(np.searchsorted(self.keys, keys), len(self) - 1)
        return np.where(known & (self.keys[places] == keys), places, -1)

    def coarser(self, level: int) -> CellSet:
        """Return the set of blocks, 2^level cells wide, that contain cells of this set."""
        return self if level == 0 else CellSet.of(self.cells >> level)


@dataclass(frozen=True, eq=False)
class Grid:
    """A grid of cubes, of which a corner or the centre of one is the map's origin.

    Args:
        edge: edge of a cell, map unit.
        bbox: (2, 3) box that cells are clipped to; None for all.
        most: largest number of cells.
        centred: whether cell 0 is centred on the origin, rather than beginning at it.
    """

    edge: float
    bbox: np.ndarray | None
    most: int
    centred: bool = False

    @property
    def start(self) -> float:
        """Lowest coordinate of cell 0 on each axis."""
        return -self.edge / 2 if self.centred else 0.0

    def bounds(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the corners (K, 3) of blocks from cell ``low`` to ``high`` (K, 3, exclusive), clipped to the box."""
        a, b = low * self.edge + self.start, high * self.edge + self.start
        return (a, b) if self.bbox is None else (np.maximum(a, self.bbox[0]), np.minimum(b, self.bbox[1]))

    def reached(
        self, boxes: OrientedBoxes, reach: float = 0.0, within: CellSet | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Find the cells within ``reach`` of each box, among all cells or those of a set.

        An octree descent for all boxes at once: each starts from the few cubes of 2^k cells around it, which are split,
        and parts without intersection are dropped, down to single cells.

        Returns:
            (K,) row of the box and (K, 3) int64 cell of every intersection.

        Raises:
            ConfigError: more cells than permitted.
        """
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            if self.bbox is None and not (np.prod(2 * boxes.halves / self.edge, axis=1) <= self.most).all():
                raise self.too_many(boxes)  # by volume alone
        first, last = self._ranges(boxes, reach)
        sizes = np.maximum(last - first, 0)
        boxed = np.flatnonzero((sizes > 0).all(1))
        level = np.zeros(len(boxes), dtype=np.int64)
        level[boxed] = np.ceil(np.log2(sizes[boxed].max(1))).astype(np.int64)
        which, low = np.zeros(0, dtype=np.int64), np.zeros((0, 3), dtype=np.int64)
        for k in range(int(level[boxed].max(initial=0)), -1, -1):
            width = 1 << k
            new = boxed[level[boxed] == k]
            begun = _corners(first[new] // width * width, width)
            which, low = np.r_[which, np.repeat(new, 8)], np.r_[low, begun]
            inside = ((low < last[which]) & (low + width > first[which])).all(1)
            if within is not None:
                inside &= within.coarser(k).find(low >> k) >= 0
            which, low = which[inside], low[inside]
            corners = self.bounds(low, low + width)
            met = boxes.touch(which, corners[0] - reach, corners[1] + reach)
            which, low = which[met], low[met]
            if len(low) > self.most and len(CellSet.of(low)) > self.most:
                raise self.too_many(boxes)
            if k:
                which, low = np.repeat(which, 8), _corners(low, width // 2)
        return which, low

    def _ranges(self, boxes: OrientedBoxes, reach: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the first cell (B, 3) of each box's bounds, and the cell after the last (B, 3)."""
        low, high = boxes.bounds[:, 0] - reach, boxes.bounds[:, 1] + reach
        if self.bbox is not None:
            low, high = np.maximum(low, self.bbox[0]), np.minimum(high, self.bbox[1])
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            first, last = np.floor((low - self.start) / self.edge), np.ceil((high - self.start) / self.edge)
            near = (np.abs(first) < _FARTHEST).all() and (np.abs(last) < _FARTHEST).all()
        if not near:
            raise self.too_many(boxes)
        return first.astype(np.int64), last.astype(np.int64)

    def too_many(self, boxes: OrientedBoxes) -> ConfigError:
        """Return the error for boxes that intersect more cells than permitted."""
        low, high = boxes.around
        spans = " x ".join(f"{side:.6g}" for side in high - low)
        return ConfigError(
            f"tiles of {self.edge:.6g} (map unit) would number more than {self.most} over {spans}: use larger "
            "tiles or a box, or increase export.max_tiles",
            code="too_many_tiles",
        )


def _key(values: tuple[np.ndarray, ...], cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a key for each cell, and a mask that is True if all coordinates of the cell occur in the set."""
    key, known = np.zeros(len(cells), dtype=np.int64), np.ones(len(cells), dtype=bool)
    for axis, of_axis in enumerate(values):
        places = np.minimum(np.searchsorted(of_axis, cells[:, axis]), len(of_axis) - 1)
        known &= of_axis[places] == cells[:, axis]
        key = key * len(of_axis) + places
    return key, known


def _corners(low: np.ndarray, width: int) -> np.ndarray:
    """Return the lowest cells (8 K, 3) of the 2 x 2 x 2 blocks, ``width`` cells wide, that begin at each cell (K,
    3).
    """
    steps = np.indices((2, 2, 2)).reshape(3, 8).T * width
    found: np.ndarray = (low[:, None] + steps).reshape(-1, 3)
    return found

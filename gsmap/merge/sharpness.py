"""Relative sharpness of overlapping scenes: places where another scene shows the same detail more sharply.

Both scenes are rendered from one scene's own camera, from which it should be the best. There the fine detail of the
other is regressed on its own. Detail that is equally sharp gives a slope below 1, because errors and small offsets of
the poses differ between the scenes; a slope above 1 shows that the own detail is blurred. Artefacts of the other scene
do not correlate with the own detail, so they do not raise the slope. Two scenes with common errors have slopes near 1
from the views of both, so the slope must also exceed that from the other scene's views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from gsmap.geometry.filters import blur
from gsmap.merge.overlap import share_in_view
from gsmap.merge.reference_view_cache import surface_axes
from gsmap.render import ChunkIndex, render
from gsmap.types import Cameras, Gaussians

_CELL_M = 0.5  # edge of the cells in which sharpness is compared
_VIEWS = 12  # largest number of own views of each scene that are compared with other scenes
_FINE_PX, _COARSE_PX = 0.5, 2.0  # standard deviations of the Gaussian windows between which detail lies
_STRIDE_PX = 2  # slopes are computed from every second pixel along each axis
_MIN_ALPHA = 0.95  # smallest alpha of a pixel that shows a surface
_MAX_DEPTH_RATIO = 0.03  # largest relative difference in depth between pixels of one surface
_MIN_PIXELS = 50  # smallest number of these pixels of a cell that another scene must show as well
_PRIOR_PIXELS = 1000.0  # a cell's slope is drawn to that of the whole scene as if by so many further pixels
_EQUAL_SLOPE = 0.8  # slope up to which a scene counts in full
_POWER = 4.0  # power of the slope by which a blurred scene counts less
_REVERSE_POWER = 2.0  # power of the ratio of both scenes' slopes, which is 1 where they are equally sharp
_MIN_SLOPE, _MIN_WEIGHT = 1e-3, 0.02


Compared = dict[tuple[int, int], tuple[np.ndarray, np.ndarray]]
"""Per scene and other scene, (M,) cells and their (M, 3) sums over pixels."""


@dataclass(eq=False)
class SharpnessComparison:
    """Comparison of the fine detail of S overlapping scenes, view by view.

    Args:
        pieces: Gaussians of each scene in the map frame, perhaps only those around a tile.
        indices: boxes of the chunks of each piece.
    """

    pieces: Sequence[Gaussians]
    indices: Sequence[ChunkIndex]
    _sums: dict[tuple[int, int], list[tuple[np.ndarray, np.ndarray]]] = field(default_factory=dict)

    def compare(
        self, scene: int, camera: Cameras, colour: np.ndarray, depth: np.ndarray, valid: np.ndarray
    ) -> Compared:
        """Compare one of a scene's own views with renders of the other scenes from its camera, for `add`.

        Args:
            camera: one camera in the map frame.
            colour: (H, W, 3) render of the scene in [0, 1].
            depth: (H, W) depth of the scene's surface.
            valid: (H, W) mask of pixels that are compared.
        """
        few = slice(None, None, _STRIDE_PX), slice(None, None, _STRIDE_PX)
        used = valid[few]
        own, depths = _detail(colour)[used], depth[few][used]
        cells = _cells(np.stack([axis[used] for axis in surface_axes(camera, depth, _STRIDE_PX)], axis=-1))
        found: Compared = {}
        for other, piece in enumerate(self.pieces):
            if other == scene or not len(piece) or not share_in_view(camera, piece.means)[0]:
                continue
            seen = render(piece, camera, dominant_id=False, index=self.indices[other])
            same = np.abs(seen.depth[0][few][used] - depths) < _MAX_DEPTH_RATIO * depths
            same &= seen.alpha[0][few][used] > _MIN_ALPHA
            if same.sum() < _MIN_PIXELS:
                continue
            theirs = np.clip(seen.colour[0], 0, 1)
            mean = float(theirs[few][used][same].mean())
            exposure = float(colour[few][used][same].mean()) / max(mean, 1e-3)
            detail = exposure * _detail(theirs)[used][same]
            values = np.ones(len(detail)), (own[same] * detail).sum(1), (own[same] ** 2).sum(1)
            where, label = np.unique(cells[same], return_inverse=True)
            sums = np.stack([np.bincount(label, row) for row in values], axis=1)
            found[scene, other] = where, sums
        return found

    def add(self, compared: Compared) -> None:
        """Add the result of `compare` for one view."""
        for pair, sums in compared.items():
            self._sums.setdefault(pair, []).append(sums)

    def weights(self) -> SharpnessWeights:
        """Return the weights of all scenes by cell."""
        slopes = {pair: _slopes(parts) for pair, parts in self._sums.items()}
        found: dict[int, dict[int, float]] = {}
        for (scene, other), (by_cell, _) in sorted(slopes.items()):
            back, mean_back = slopes.get((other, scene), ({}, 0.0))
            mine = found.setdefault(scene, {})
            for cell, slope in by_cell.items():
                reverse = back.get(cell, mean_back)
                weight = max((_EQUAL_SLOPE / slope) ** _POWER, (reverse / slope) ** _REVERSE_POWER, _MIN_WEIGHT)
                mine[cell] = min(weight, mine.get(cell, 1.0))
        return SharpnessWeights(
            {
                scene: (np.array(sorted(mine), dtype=np.int64), np.array([mine[cell] for cell in sorted(mine)]))
                for scene, mine in found.items()
                if mine
            }
        )


@dataclass(frozen=True, eq=False)
class SharpnessWeights:
    """Weight in (0, 1] of each scene by cell; 1 where no other scene is sharper.

    Args:
        of_scene: per scene, the (M,) sorted cells and their (M,) weights.
    """

    of_scene: dict[int, tuple[np.ndarray, np.ndarray]]

    def at(self, scene: int, points: np.ndarray) -> np.ndarray:
        """Return the weights (...) of a scene at points (..., 3) in the map frame, means over the nearest eight
        cells as far as these are known."""
        if scene not in self.of_scene:
            return np.ones(points.shape[:-1])
        known, weights = self.of_scene[scene]
        lowest = _cells(points - _CELL_M / 2)
        near = np.unique(lowest)  # most points share a few cells
        total, count = np.zeros(len(near)), np.zeros(len(near))
        for x, y, z in np.ndindex(2, 2, 2):
            cells = near + (x << 42) + (y << 21) + z
            at = np.minimum(np.searchsorted(known, cells), len(known) - 1)
            found = known[at] == cells
            total += np.where(found, weights[at], 0.0)
            count += found
        means = np.where(count > 0, total / np.maximum(count, 1), 1.0)
        out: np.ndarray = means[np.searchsorted(near, lowest)]
        return out


def compared_views(scenes: Sequence[int]) -> set[int]:
    """Select at most `_VIEWS` rows of each scene, evenly, from the scenes of all views (V,)."""
    scene_of = np.asarray(scenes, dtype=np.int64)
    chosen: set[int] = set()
    for scene in np.unique(scene_of):
        rows = np.flatnonzero(scene_of == scene)
        chosen |= set(rows[:: -(-len(rows) // _VIEWS)].tolist())
    return chosen


def _slopes(parts: list[tuple[np.ndarray, np.ndarray]]) -> tuple[dict[int, float], float]:
    """Return the slope in each cell that both scenes show, and the slope of all views.

    Args:
        parts: per view the cells (K,) and the (K, 3) numbers of pixels, sums of products of the detail of both scenes,
            and sums of squares of the own detail.
    """
    rows = np.concatenate([sums for _, sums in parts])
    cells, label = np.unique(np.concatenate([where for where, _ in parts]), return_inverse=True)
    count, both, own = (np.bincount(label, column) for column in rows.T)
    mean_both, mean_own = rows[:, 1:].sum(0) / rows[:, 0].sum()
    slope = (both + _PRIOR_PIXELS * mean_both) / np.maximum(own + _PRIOR_PIXELS * mean_own, 1e-9)
    shown, slope = count >= _MIN_PIXELS, np.maximum(slope, _MIN_SLOPE)
    by_cell = dict(zip(cells[shown].tolist(), slope[shown].tolist(), strict=True))
    return by_cell, max(float(mean_both / max(mean_own, 1e-9)), _MIN_SLOPE)


def _detail(colour: np.ndarray) -> np.ndarray:
    """Return the fine detail of an image (H, W, 3) at every `_STRIDE_PX`-th pixel: the difference of two Gaussian
    windows."""
    return blur(colour, _FINE_PX, step=_STRIDE_PX) - blur(colour, _COARSE_PX, step=_STRIDE_PX)


def _cells(points: np.ndarray) -> np.ndarray:
    """Return the (...) int64 cells of points (..., 3)."""
    at = np.floor(points / _CELL_M).astype(np.int64)
    out: np.ndarray = (at[..., 0] << 42) + (at[..., 1] << 21) + at[..., 2]
    return out

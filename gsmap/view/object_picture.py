"""Draw pictures of objects: each from the view that shows it best, in front of its faded surroundings."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from gsmap.geometry.projection import in_image, project
from gsmap.render import ChunkIndex, render
from gsmap.types import Cameras, PosedScene

_MAX_VIEWS = 72  # number of a scene's cameras, spread evenly, among which that of an object is chosen
_VIEW_PX = 120  # longest side of the views by which it is chosen
_POINTS = 300  # maximum number of an object's Gaussians that are projected
_LARGE = 0.06  # fraction of a view from which on an object is large enough
_BORDER = 0.03  # width of the border of a view, relative to its sides, in which an object may be cut off
_MIN_PIXELS = 6  # smallest number of pixels of a view that show an object
_STRAYS = 0.03  # fraction of an object's points beyond each side of its box in a view
_MARGIN = 0.4  # margin around an object, as a fraction of its size
_MIN_CROP = 0.3  # smallest crop as a fraction of the view, so that small objects have context
_BEYOND = 0.1  # a crop may reach so far beyond a view, relative to its sides: Gaussians are there, too
_ASPECT = 4 / 3
_FADED = 0.55  # fraction of grey in what is around the object
_BACKGROUND = 0.7  # grey where no Gaussian is
_MIN_PART = 0.1  # smallest part of an object that is outlined, relative to its largest part
_OUTLINE = (235, 64, 52)


class BestView(NamedTuple):
    """The view of a scene that shows a segment best.

    Args:
        score: product of the fractions of the segment within the view (to the fourth power) and visible, and of the
            square roots of its size relative to a large one, and of its visible area relative to that in other views.
        camera: index of the camera among the scene's cameras.
        box: left, top, right and bottom around the segment, as fractions of the view's sides.
    """

    score: float
    camera: int
    box: tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class SegmentedViews:
    """A scene in a metric frame with the segment of each of its Gaussians.

    Args:
        scene: the scene, with cameras.
        members: (N,) segment of each Gaussian; -1 for none.
    """

    scene: PosedScene
    members: np.ndarray

    @cached_property
    def _index(self) -> ChunkIndex:
        return ChunkIndex.build(self.scene.gaussians)

    def best_views(self) -> list[BestView | None]:
        """Find the view that shows each segment best: unhidden, whole and large; None for a segment without any."""
        cameras, count = self.scene.cameras, int(self.members.max(initial=-1)) + 1
        if cameras is None or not len(cameras) or not count:
            return [None] * count
        points, of = self._sampled(count)
        chosen = np.unique(np.linspace(0, len(cameras) - 1, min(len(cameras), _MAX_VIEWS)).astype(int))
        small = cameras.resized(_VIEW_PX)
        scores, areas = np.stack([self._scores(small[int(view)], points, of, count) for view in chosen], axis=1)
        scores *= np.sqrt(areas / np.maximum(areas.max(0), 1e-12))
        out: list[BestView | None] = []
        starts = np.searchsorted(of, np.arange(count + 1))  # points are sorted by segment
        for segment, view in enumerate(np.argmax(scores, axis=0)):
            camera, score = int(chosen[view]), float(scores[view, segment])
            box = _box_in(small[camera], points[starts[segment] : starts[segment + 1]])
            out.append(BestView(score, camera, box) if score > 0 else None)
        return out

    def draw(self, segment: int, view: BestView, side_px: int) -> np.ndarray:
        """Draw a segment in a view, outlined in a picture (H, W, 3) uint8.

        Args:
            side_px: longer side of the picture.
        """
        assert self.scene.cameras is not None
        colour, shown, _ = self._segments(_cropped(self.scene.cameras[view.camera], view.box, side_px))
        return _outlined(colour, shown == segment)

    def _sampled(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return Gaussians (K, 3) of all segments, a limited number of each, and their segments (K,)."""
        rows = np.flatnonzero(self.members >= 0)
        rows = rows[np.argsort(self.members[rows], kind="stable")]
        sizes = np.bincount(self.members[rows], minlength=count)
        rank = np.arange(len(rows)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        rows = rows[rank % np.repeat(-(-sizes // _POINTS), sizes) == 0]
        return self.scene.gaussians.means[rows].astype(np.float64), self.members[rows]

    def _scores(self, camera: Cameras, points: np.ndarray, of: np.ndarray, count: int) -> np.ndarray:
        """Return the (2, M) score of each segment in a small view, and the area of its surface, across the line of
        sight."""
        _, shown, far = self._segments(camera)
        pixels, depth = project(points, camera.T_camera_frame[0], camera.intrinsics_px[0])
        size = camera.sizes_px[0]
        there = np.flatnonzero(in_image(pixels, depth, size))
        pixels, mine = pixels[there], of[there]
        is_whole = (np.minimum(pixels, size - pixels) > _BORDER * size).all(1)
        whole = np.bincount(mine[is_whole], minlength=count) / np.maximum(np.bincount(of, minlength=count), 1)
        # Pixels on which the points lie, widened by one, as the points are sparse.
        column, row = pixels.astype(int).T
        _, first = np.unique(np.stack([mine, row, column]), axis=1, return_index=True)
        mine, row, column = mine[first], row[first], column[first]
        padded = np.pad(shown, 1, constant_values=-1)
        beside = [padded[row + down, column + right] == mine for down in range(3) for right in range(3)]
        visible = np.bincount(mine[np.any(beside, axis=0)], minlength=count) / np.maximum(
            np.bincount(mine, minlength=count), 1
        )
        pixel_counts = np.bincount(shown[shown >= 0], minlength=count)
        large = np.minimum(1.0, pixel_counts / (_LARGE * shown.size)) ** 0.5
        area = np.bincount(shown[shown >= 0], far[shown >= 0] ** 2, count)
        return np.stack([np.where(pixel_counts >= _MIN_PIXELS, whole**4 * visible * large, 0.0), area])

    def _segments(self, camera: Cameras) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Render one camera: colours (H, W, 3), and the segment (H, W), -1 for none, and depth (H, W) of each pixel."""
        seen = render(self.scene.gaussians, camera, index=self._index)
        ids, alpha = seen.dominant_id[0], seen.alpha[0]
        colour = seen.colour[0] + _BACKGROUND * np.maximum(1 - 2 * alpha, 0)[..., None]
        return colour, np.where(ids >= 0, self.members[ids], -1), np.nan_to_num(seen.depth[0])


def _box_in(camera: Cameras, points: np.ndarray) -> tuple[float, float, float, float]:
    """Return left, top, right and bottom around most of some points in a view, as fractions of its sides."""
    pixels, depth = project(points, camera.T_camera_frame[0], camera.intrinsics_px[0])
    pixels = pixels[depth > 0] / camera.sizes_px[0]
    if not len(pixels):
        return 0.0, 0.0, 1.0, 1.0
    low, high = np.quantile(pixels, [_STRAYS, 1 - _STRAYS], axis=0).tolist()
    return low[0], low[1], high[0], high[1]


def _cropped(camera: Cameras, box: tuple[float, float, float, float], side_px: int) -> Cameras:
    """Return the camera cropped around a box (fractions of the view's sides) with margins, and resized."""
    size = camera.sizes_px[0].astype(np.float64)
    width, height = size
    low, high = np.clip(np.array(box).reshape(2, 2), -_BEYOND, 1 + _BEYOND) * size
    wide, tall = np.maximum((high - low) * (1 + 2 * _MARGIN), _MIN_CROP * width)
    wide = min(max(wide, tall * _ASPECT), max(width, height * _ASPECT))
    crop = np.array([wide, wide / _ASPECT])
    most = np.maximum((1 + _BEYOND) * size - crop, -_BEYOND * size)
    corner = np.clip((low + high - crop) / 2, -_BEYOND * size, most)
    intrinsics = camera.intrinsics_px * side_px / wide - np.array([0, 0, *(corner * side_px / wide)])
    return Cameras(camera.T_frame_camera, intrinsics, np.array([[side_px, round(side_px / _ASPECT)]]), camera.names)


def _outlined(colour: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """Return the picture (H, W, 3) uint8 of an object (H, W mask) with an outline, in front of faded surroundings."""
    from scipy.ndimage import label, median_filter

    picture = np.clip(np.nan_to_num(colour), 0, 1)
    shown = median_filter(shown, size=max(3, shown.shape[1] // 60 | 1))
    parts, count = label(shown)
    sizes = np.bincount(parts.ravel(), minlength=count + 1)
    shown = shown & (sizes >= _MIN_PART * sizes[1:].max(initial=0))[parts]
    grey = picture.mean(-1, keepdims=True)
    faded = (1 - _FADED) * picture + _FADED * (0.35 + 0.5 * grey)
    picture = np.where(_widened(shown)[..., None], picture, faded)
    out: np.ndarray = np.round(picture * 255).astype(np.uint8)
    out[_widened(_widened(shown)) & ~_widened(shown)] = _OUTLINE
    return out


def _widened(mask: np.ndarray) -> np.ndarray:
    """Return a mask (H, W) widened by a pixel in every direction."""
    padded = np.pad(mask, 1)
    across = padded[:, :-2] | padded[:, 1:-1] | padded[:, 2:]
    out: np.ndarray = across[:-2] | across[1:-1] | across[2:]
    return out

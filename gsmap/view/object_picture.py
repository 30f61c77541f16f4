"""Draw pictures of objects: each from the view that shows it best, in front of its faded surroundings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

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
_MARGIN = 0.45  # margin around an object, as a fraction of its size
_MIN_CROP = 0.3  # smallest crop as a fraction of the view, so that small objects have context
_ASPECT = 4 / 3
_FADED = 0.55  # fraction of grey in what is around the object
_MIN_PART = 0.1  # smallest part of an object that is outlined, relative to its largest part
_OUTLINE = (235, 64, 52)


@dataclass(frozen=True, eq=False)
class SegmentedViews:
    """A scene in a metric frame with the segment of each of its Gaussians.

    Args:
        scene: the scene, with cameras.
        members: (N,) segment of each Gaussian; -1 for none.
        known: `shown` of the same scene, if it was computed before.
    """

    scene: PosedScene
    members: np.ndarray
    known: Sequence[np.ndarray] | None = None

    @cached_property
    def _cameras(self) -> Cameras:
        cameras = self.scene.cameras
        assert cameras is not None
        return cameras[np.unique(np.linspace(0, len(cameras) - 1, min(len(cameras), _MAX_VIEWS)).astype(int))]

    @cached_property
    def _index(self) -> ChunkIndex:
        return ChunkIndex.build(self.scene.gaussians)

    @cached_property
    def shown(self) -> Sequence[np.ndarray]:
        """Per view the (H, W) segment at each pixel of a small picture; -1 for none."""
        cameras = self._cameras.resized(_VIEW_PX)
        return self.known or [self._segments(cameras[view])[1] for view in range(len(cameras))]

    def draw(self, segment: int, side_px: int) -> np.ndarray | None:
        """Draw a segment, outlined in a picture (H, W, 3) uint8; None if no view shows it.

        Args:
            side_px: longer side of the picture.
        """
        found = self._best_view(segment)
        if found is None:
            return None
        camera = _cropped(self._cameras[found], self.shown[found] == segment, side_px)
        colour, shown = self._segments(camera)
        return _outlined(colour, shown == segment)

    def _best_view(self, segment: int) -> int | None:
        """Return the view that shows most of a segment, unhidden, whole and large enough; None without any."""
        points = self.scene.gaussians.means[self.members == segment]
        if not len(points):
            return None
        points = points[:: -(-len(points) // _POINTS)].astype(np.float64)
        scores = [self._score(view, segment, points) for view in range(len(self._cameras))]
        best = int(np.argmax([0.0, *scores])) - 1
        return best if best >= 0 else None

    def _score(self, view: int, segment: int, points: np.ndarray) -> float:
        shown = self.shown[view] == segment
        count = int(shown.sum())
        if count < _MIN_PIXELS:
            return 0.0
        camera = self._cameras[view].resized(_VIEW_PX)
        pixels, depth = project(points, camera.T_camera_frame[0], camera.intrinsics_px[0])
        there = in_image(pixels, depth, camera.sizes_px[0])
        size = camera.sizes_px[0]
        whole = there & (np.minimum(pixels, size - pixels) > _BORDER * size).all(1)
        # Pixels of the views on which the points lie, widened by one, as the points are sparse.
        covered = np.zeros(shown.shape, dtype=bool)
        column, row = pixels[there].astype(int).T
        covered[row, column] = True
        visible = (_widened(shown) & covered).sum() / max(int(covered.sum()), 1)
        return float(whole.mean() ** 2 * visible * min(1.0, count / (_LARGE * shown.size)) ** 0.5)

    def _segments(self, camera: Cameras) -> tuple[np.ndarray, np.ndarray]:
        """Render one camera: colours (H, W, 3) and the segment (H, W) at each pixel, -1 for none."""
        seen = render(self.scene.gaussians, camera, depth=False, index=self._index)
        ids = seen.dominant_id[0]
        return seen.colour[0], np.where(ids >= 0, self.members[ids], -1)


def _cropped(camera: Cameras, shown: np.ndarray, side_px: int) -> Cameras:
    """Return the camera cropped around the pixels (h, w) of a small view that show an object, and resized."""
    width, height = camera.sizes_px[0].tolist()
    rows, columns = np.nonzero(shown)
    scale = width / shown.shape[1]
    low = np.array([np.quantile(columns, 0.02), np.quantile(rows, 0.02)]) * scale
    high = (np.array([np.quantile(columns, 0.98), np.quantile(rows, 0.98)]) + 1) * scale
    wide, tall = np.maximum((high - low) * (1 + 2 * _MARGIN), _MIN_CROP * width)
    wide = min(max(wide, tall * _ASPECT), width, height * _ASPECT)
    size = np.array([wide, wide / _ASPECT])
    corner = np.clip((low + high - size) / 2, 0, np.array([width, height]) - size)
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

"""What the cameras of a scene see of it: rendered once, kept, and chosen among."""

from __future__ import annotations

from collections import OrderedDict
from functools import cached_property

import numpy as np

from gsmap.render import Rendered, render
from gsmap.types import Cameras, Gaussians

_KEPT = 64  # renders of 128 x 96 pixels: 16 MB
_COARSE_PX = 16
_COARSE_POINTS = 8_000
_COARSE_MARGIN = 0.1  # of the depth: half a coarse pixel of a slanted wall


class Sight:
    """A scene through its own cameras, in its own frame and unit.

    These renders do not depend on any pose, so a scene that meets many others is rendered once; the latest are kept.
    """

    def __init__(self, gaussians: Gaussians, cameras: Cameras, size_px: int) -> None:
        g = gaussians
        # The mean colour alone: the rest was fitted to directions from which the other scene's cameras do not look.
        self.gaussians = Gaussians(g.means, g.quats, g.log_scales, g.logit_opacities, g.sh[:, :1])
        self.cameras = cameras.resized(size_px)
        self._renders: OrderedDict[int, Rendered] = OrderedDict()

    def shot(self, row: int) -> Rendered:
        """Colour, alpha and depth (1, H, W) of the view of one camera."""
        if row not in self._renders:
            # On the CPU everywhere: a verdict is the same bits on every machine and in every run.
            self._renders[row] = render(self.gaussians, self.cameras[[row]], dominant_id=False, backend="native")
            while len(self._renders) > _KEPT:
                self._renders.popitem(last=False)
        self._renders.move_to_end(row)
        return self._renders[row]

    def choose(self, points: np.ndarray, count: int) -> list[int]:
        """The cameras to which most of some points (N, 3) are visible, or stand in the way; see `choose_cameras`."""
        return choose_cameras(self._coarse, points, count, self._nearest)

    @cached_property
    def _coarse(self) -> Cameras:
        return self.cameras.resized(_COARSE_PX)

    @cached_property
    def _nearest(self) -> list[np.ndarray]:
        """Nearest depth of each coarse pixel of each camera, by a sample of opaque centres: enough to choose by."""
        solid = np.flatnonzero(self.gaussians.logit_opacities > 0.0)
        rows = solid[np.linspace(0, len(solid) - 1, min(len(solid), _COARSE_POINTS)).astype(int)]
        points, views, out = self.gaussians.means[rows], self._coarse.T_camera_frame, []
        for view, intrinsics, (width, height) in zip(
            views, self._coarse.intrinsics_px, self._coarse.sizes_px, strict=True
        ):
            pixel, z, _ = _project(points, view, intrinsics, width, height)
            nearest = np.full(width * height, np.inf, np.float32)
            np.minimum.at(nearest, pixel, z)
            out.append(nearest * np.float32(1 + _COARSE_MARGIN))
        return out


def choose_cameras(
    cameras: Cameras, points: np.ndarray, count: int, nearest: list[np.ndarray] | None = None
) -> list[int]:
    """Greedy choice of the cameras with most of the points in front of them, each point counted once.

    Args:
        nearest: flat depth image of each camera; points behind it are hidden and do not count.
    """
    sample = points[np.linspace(0, len(points) - 1, min(len(points), 1000)).astype(int)].astype(np.float32)
    inside = np.zeros((len(cameras), len(sample)), dtype=bool)
    for c, view in enumerate(cameras.T_camera_frame):
        pixel, z, at = _project(sample, view, cameras.intrinsics_px[c], *cameras.sizes_px[c])
        inside[c, at if nearest is None else at[z <= nearest[c][pixel]]] = True
    left, chosen = np.ones(len(sample), dtype=bool), []
    for _ in range(min(count, len(cameras))):
        gain = (inside & left).sum(1)
        best = int(gain.argmax())
        if not gain[best]:
            break
        chosen.append(best)
        left &= ~inside[best]
    return chosen


def _project(
    points: np.ndarray, view: np.ndarray, intrinsics: np.ndarray, width: int, height: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Flat pixel index, depth and row of the points (float32) that fall into an image."""
    local = points @ view[:3, :3].T.astype(np.float32) + view[:3, 3].astype(np.float32)
    at = np.flatnonzero(local[:, 2] > 0.0)
    local = local[at]
    z = local[:, 2]
    u = np.floor(local[:, 0] / z * intrinsics[0] + intrinsics[2])
    v = np.floor(local[:, 1] / z * intrinsics[1] + intrinsics[3])
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    return (v[inside] * width + u[inside]).astype(np.int64), z[inside], at[inside]

"""Estimate the displacement of the content of a splat render towards the image centre.

Gaussians that overlap are drawn front to back. On a slanted surface, Gaussians with nearer means cover those with
farther means, so a pixel shows more of the nearer Gaussians. These lie farther from the image centre, so content is
pulled towards the centre. Training corrects most of the displacement but not all, because views from other directions
need another correction. Thus content is a little smaller in renders than in photos, the more so the larger the
Gaussians are, and uncorrected poses lie too near.
"""

from __future__ import annotations

import numpy as np

from gsmap.geometry.filters import box_means
from gsmap.geometry.projection import project
from gsmap.localize.map_scene import MapScene

FRACTION = 0.16
"""Share of the distance from a pixel to the means of its Gaussians that remains after training
(``tools/fit/localize.py``)."""

MAX_PX = 2.0
"""Limit of that distance along each axis, for a render of 480 pixels: larger Gaussians have no well-defined
position."""

WINDOW_PX = 36.0
"""Width of the square over which the displacement is averaged, for a render of 480 pixels."""

RENDER_SIDE_PX = 120
"""Longer side of the small render from which the displacement is computed."""


def displacement_map(
    scene: MapScene,
    T_metric_camera: np.ndarray,
    intrinsics_px: np.ndarray,
    size_px: tuple[int, int],
    fraction: float | None = None,
) -> np.ndarray:
    """Return (R, C, 2) float32 displacements of a render's content (right and down, in pixels) on a coarser grid.

    Args:
        intrinsics_px: (4,) intrinsics of the render at ``size_px``.
        fraction: used instead of `FRACTION`.
    """
    longest = max(size_px)
    by = max(1, round(longest / RENDER_SIDE_PX))
    small = (size_px[0] // by, size_px[1] // by)
    camera = scene.camera(T_metric_camera, intrinsics_px / by, small)
    means, alpha = scene.render_positions(camera)
    points = scene.S_metric_scene.apply(means.reshape(-1, 3).astype(np.float64))
    at, depth = project(points, np.linalg.inv(T_metric_camera), intrinsics_px / by)
    row, column = np.mgrid[0 : small[1], 0 : small[0]]
    offset = (at - np.stack([column, row], axis=2).reshape(-1, 2) - 0.5) * by
    offset[(depth <= 0) | (alpha.ravel() < 0.9)] = 0
    limit = MAX_PX * longest / 480
    width = 2 * round(WINDOW_PX * longest / 480 / by / 2) + 1
    offset = np.clip(offset, -limit, limit).reshape(*alpha.shape, 2).astype(np.float32)
    out: np.ndarray = np.float32(FRACTION if fraction is None else fraction) * box_means(offset, width)
    return out

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
from gsmap.render import Rendering

FRACTION = 0.16
"""Share of the distance from a pixel to the means of its Gaussians that remains after training
(``tools/fit/localize.py``)."""

MAX_PX = 2.0
"""Limit of that distance along each axis, for a render of 480 pixels: larger Gaussians have no well-defined
position."""

WINDOW_PX = 36.0
"""Width of the square over which the displacement is averaged, for a render of 480 pixels."""

GRID_SIDE = 120
"""Number of cells along the longer side of a displacement map."""


def displacement_map(rendered: Rendering, fraction: float | None = None) -> np.ndarray:
    """Return (R, C, 2) float32 displacements of a render's content (right and down, in pixels) on a coarser grid.

    Args:
        rendered: a render of one camera, with the positions of centres.
        fraction: used instead of `FRACTION`.
    """
    alpha = rendered.alpha[0]
    longest = max(alpha.shape)
    by = max(1, round(longest / GRID_SIDE))
    row, column = np.mgrid[0 : alpha.shape[0], 0 : alpha.shape[1]].astype(np.float32) + np.float32(0.5)
    offset = rendered.centre[0] - np.stack([column, row], axis=2)
    offset[alpha < 0.9] = 0
    limit = MAX_PX * longest / 480
    width = 2 * round(WINDOW_PX * longest / 480 / 2) + 1
    means = box_means(np.clip(offset, -limit, limit), width, first=by // 2, step=by)
    out: np.ndarray = np.float32(FRACTION if fraction is None else fraction) * means
    return out

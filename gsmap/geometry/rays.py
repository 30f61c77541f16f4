"""Intersect a ray with the surface of Gaussians."""

from __future__ import annotations

import numpy as np

from gsmap.geometry.rotations import quats_to_matrices
from gsmap.types import Gaussians

_LEAST = 1 / 255  # smallest opacity, as in the rasterizer
_NEAR = 0.01
_ALPHA_MAX = 0.99


def surface_along(
    gaussians: Gaussians, origin: np.ndarray, direction: np.ndarray, min_opacity: float = 0.5
) -> tuple[float, float] | None:
    """Return the distance of the surface along a ray and the thickness of the surface; None if the ray meets too little
    opacity.

    Every Gaussian absorbs light at its peak along the ray, with its opacity there; the surface is where half of the
    total absorption has happened. A rendered depth instead averages the centres of Gaussians, which lie beside the ray;
    on a slanted surface its error is as large as the Gaussians.

    Args:
        gaussians: Gaussians in the frame of the ray.
        origin, direction: (3,) origin and direction of the ray; distances are in lengths of the direction.
        min_opacity: smallest opacity of all Gaussians along the ray together.

    Returns:
        The distance; and, as thickness, half of the distance between the points where 16 % and 84 % of the absorption
        have happened.
    """
    o, d = np.asarray(origin, dtype=np.float64), np.asarray(direction, dtype=np.float64)
    to_centre = gaussians.means.astype(np.float64) - o
    along = to_centre @ d / (d @ d)
    beside = np.linalg.norm(to_centre - along[:, None] * d, axis=1)
    reach = 3.5 * np.exp(gaussians.log_scales.max(1).astype(np.float64))
    rows = np.flatnonzero(beside < reach)
    if not len(rows):
        return None
    # Work in the axes of each Gaussian, in units of its standard deviations.
    turn = quats_to_matrices(gaussians.quats[rows].astype(np.float64))
    shrink = np.exp(-gaussians.log_scales[rows].astype(np.float64))
    p = np.einsum("nji,nj->ni", turn, to_centre[rows]) * shrink
    q = np.einsum("nji,j->ni", turn, d) * shrink
    peak = (p * q).sum(1) / (q * q).sum(1)
    beyond = ((p - peak[:, None] * q) ** 2).sum(1)
    alpha = np.minimum(_ALPHA_MAX, np.exp(-beyond / 2) / (1 + np.exp(-gaussians.logit_opacities[rows].astype(float))))
    keep = (alpha >= _LEAST) & (peak > _NEAR / np.linalg.norm(d))
    order = np.argsort(peak[keep])
    peak, alpha = peak[keep][order], alpha[keep][order]
    stopped = 1 - np.cumprod(1 - alpha)
    if not len(stopped) or stopped[-1] < min_opacity:
        return None
    share = stopped / stopped[-1]
    low, middle, high = (float(peak[int(np.searchsorted(share, quantile))]) for quantile in (0.16, 0.5, 0.84))
    return middle, (high - low) / 2

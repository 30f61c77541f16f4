"""Fit a similarity to corresponding points in closed form (Umeyama 1991)."""

from __future__ import annotations

import numpy as np

from gsmap.errors import InputError
from gsmap.types import Sim3


def umeyama(
    target: np.ndarray, source: np.ndarray, *, with_scale: bool = False, weights: np.ndarray | None = None
) -> Sim3:
    """Return ``S_target_source`` that minimizes the weighted squared distance between corresponding points.

    This is Umeyama 1991 (eqs. 34-43); with ``with_scale=False`` it is the SVD solution of Arun/Kabsch. The rotation is
    always proper: for a mirrored set the best proper rotation is returned, with a large residual.

    Args:
        target, source: (N, 3) points in their own frames, N >= 3.
        with_scale: estimate the scale too.
        weights: (N,) non-negative weights.

    Raises:
        InputError: there are fewer than 3 points, shapes differ, or all source points coincide.
    """
    target = np.asarray(target, dtype=np.float64)
    source = np.asarray(source, dtype=np.float64)
    if target.shape != source.shape or target.ndim != 2 or target.shape[1] != 3 or len(target) < 3:
        raise InputError(
            f"umeyama needs two sets (N, 3) of corresponding points with N >= 3, got {target.shape}, {source.shape}",
            code="degenerate_points",
        )
    w = np.full(len(target), 1.0 / len(target)) if weights is None else np.asarray(weights, float) / np.sum(weights)
    mean_t, mean_s = w @ target, w @ source
    t, s = target - mean_t, source - mean_s
    u, singular, vt = np.linalg.svd((t * w[:, None]).T @ s)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt)) or 1.0])
    rotation = (u * sign) @ vt
    scale = 1.0
    if with_scale:
        variance = float(w @ (s**2).sum(1))
        if variance <= 0:
            raise InputError("umeyama cannot find a scale: all source points coincide", code="degenerate_points")
        scale = float((singular * sign).sum() / variance)
        if scale <= 0:
            raise InputError("umeyama found no positive scale: the points do not correspond", code="degenerate_points")
    return Sim3(rotation, mean_t - scale * rotation @ mean_s, scale)

"""Propagate pose covariances to points."""

from __future__ import annotations

import numpy as np

from gsmap.geometry.rotations import skew
from gsmap.types import ScenePose


def middle_covariance_m2(pose: ScenePose, middle: np.ndarray, metres_per_unit: float) -> np.ndarray | None:
    """Return the (3, 3) covariance, in square metres along the component's axes, of a point that is fixed to a scene.

    Args:
        middle: (3,) the point, in the scene's frame and unit.
        metres_per_unit: metres per unit of the component's frame.
    """
    if pose.covariance is None:
        return None
    S = pose.S_map_scene
    moves = S.scale * S.rotation @ point_jacobian(middle)
    found: np.ndarray = metres_per_unit**2 * moves @ pose.covariance @ moves.T
    return found if np.isfinite(found).all() else None


def point_jacobian(point: np.ndarray) -> np.ndarray:
    """Return the Jacobian (3, 7) of a point (3,) of a frame, in that frame, with respect to the pose of the frame.

    To first order, ``S Exp(xi) m = S (m + rot x m + trans + log_scale m)`` for a tangent on the frame's side
    (`gsmap.types.ScenePose`), so the point moves by ``[-skew(m) | I | m] xi``.
    """
    return np.concatenate([-skew(point), np.eye(3), point[:, None]], axis=1)


def largest_sigma(covariance: np.ndarray) -> float:
    """Return the standard deviation in the least certain direction of a covariance (N, N)."""
    return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1].clip(0)))


def max_sigmas(covariance: np.ndarray | None) -> tuple[float, float]:
    """Return the largest standard deviations of rotation (rad) and of translation; inf if the covariance is None."""
    if covariance is None:
        return np.inf, np.inf
    return largest_sigma(covariance[:3, :3]), largest_sigma(covariance[3:6, 3:6])

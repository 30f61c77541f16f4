"""Fit a similarity to a set of correspondences, or state why none fits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.geometry.umeyama import umeyama
from gsmap.reason_codes import reason
from gsmap.types import Sim3

_MAX_ROTATION_SIGMA_DEG = 3.0  # about any axis; with a larger value the correspondences lie along a line
# Largest root mean square residual, in standard deviations of a node's position. An inlier's residual is sqrt(2) of
# them per axis, or 2.45 over three axes. Twice as much may still be a correct match of poorly repeatable nodes, which
# the surfaces then verify.
_MAX_RMS_SIGMAS = 6.0


@dataclass(frozen=True, eq=False)
class PoseFit:
    """A closed-form pose and its uncertainty.

    Args:
        S_target_source: the pose.
        rms_m: root mean square distance of the correspondences under it.
        rotation_sigma_rad: standard deviation of the rotation about its least certain axis.
        flaw: reason why the pose must not be used; empty if it may.
    """

    S_target_source: Sim3
    rms_m: float
    rotation_sigma_rad: float
    flaw: str = ""


def fit_pose(
    target: np.ndarray,
    source: np.ndarray,
    *,
    with_scale: bool = False,
    sigma_m: float = 0.03,
) -> PoseFit:
    """Fit a least-squares pose to (N, 3) corresponding points; flag mirrored and near-collinear sets as flawed.

    Distances do not distinguish a set from its mirror image, so a clique may be mirrored: then an improper rotation
    fits, and no proper rotation does. Points along a line leave the rotation about it free: for positions with the
    standard deviation ``sigma_m`` the standard deviation of the rotation is the largest eigenvalue of ``F^-1/2``, where
    ``F = sum(|x|^2 I - x x^T) / (2 sigma^2)``.
    """
    if len(target) < 3:
        return PoseFit(Sim3.identity(), np.inf, np.inf, "fewer than 3 correspondences")
    pose = umeyama(target, source, with_scale=with_scale)
    rms = _rms(target, pose.apply(source))
    centred = target - target.mean(0)
    squares = centred.T @ centred
    weakest = np.linalg.eigvalsh(np.trace(squares) * np.eye(3) - squares)[0] / (2 * max(sigma_m, rms / 2.45) ** 2)
    rotation_sigma = float(1.0 / np.sqrt(weakest)) if weakest > 0 else np.inf
    flaw = ""
    if rms > sigma_m:
        mirrored = source * [1.0, 1.0, -1.0]
        if _rms(target, umeyama(target, mirrored, with_scale=with_scale).apply(mirrored)) < 0.5 * rms:
            flaw = reason("mirrored_correspondences", "correspondences are mirrored")
    if not flaw and rotation_sigma > np.radians(_MAX_ROTATION_SIGMA_DEG):
        flaw = reason("collinear_correspondences", "correspondences lie along a line")
    if not flaw and rms > _MAX_RMS_SIGMAS * sigma_m:
        flaw = reason("inconsistent_correspondences", "no single pose fits the correspondences")
    return PoseFit(pose, rms, rotation_sigma, flaw)


def _rms(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(((a - b) ** 2).sum(1).mean()))

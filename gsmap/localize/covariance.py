"""Estimate the covariance of a photo's pose from residuals, from the agreement of renders, and from the poses of
scenes."""

from __future__ import annotations

import numpy as np

from gsmap.geometry.rotations import skew
from gsmap.localize import direct_alignment, resection
from gsmap.localize.map_scene import MapScene
from gsmap.types import Sim3

# Fitted on synthetic places by ``tools/fit/localize.py PLACES sigma``.
MODEL_SIGMA_M, MODEL_SIGMA_RAD = 0.003, 0.0003
"""Standard deviations of a pose due to errors without residuals: splats lie beside the surfaces that photos show."""

PATCH_SCALE, ALIGNMENT_SCALE = 2.1, 4.7
"""Factors by which the residuals of patches and of colours underestimate sigmas if the agreement is 0.5."""

AGREEMENT_SLOPE = 2.0
"""Sigmas are multiplied by exp(slope * (0.5 - agreement)), because renders that agree less give less accurate poses."""

DIFFERENCE_WEIGHT = 0.25
"""Share of the squared difference between the pose from patches and the pose from colours that is added to the
covariance."""

_BLOCKS = (6, 4)  # columns and rows of blocks; residuals within a block are correlated
_MIN_PATCH_SIGMA_PX = 0.15  # for a photo of 480 pixels


def patch_covariance(
    fit: resection.LeastSquaresPose, pixels: np.ndarray, size_px: tuple[int, int], focal_sigma: float
) -> np.ndarray:
    """Return the (dim, dim) covariance over [rot_rad, trans, log focal length] on the camera's side, from residuals of
    patches.

    Args:
        pixels: (K, 2) positions of the patches.
        focal_sigma: as in `Photo`; an estimated focal length adds to the covariance of the pose.
    """
    min_variance = (_MIN_PATCH_SIGMA_PX * max(size_px) / 480) ** 2
    weights = np.repeat(fit.weights[:, None], 2, axis=1)
    prior = 1 / focal_sigma**2 if 0 < focal_sigma < np.inf else 0.0
    found = _cluster_sandwich(fit.jacobian, weights, fit.residuals_px, pixels / size_px, min_variance, prior)
    return found * PATCH_SCALE**2


def alignment_covariance(
    fit: direct_alignment.DirectAlignment, size_px: tuple[int, int], focal_sigma: float
) -> np.ndarray:
    """Return the (dim, dim) covariance, as `patch_covariance` does, from the colour residuals of a direct alignment.

    Args:
        size_px: size of the aligned photo.
    """
    noise = float((fit.weights * fit.residuals**2).sum() / max(fit.weights.sum(), 1e-9))
    prior = noise / focal_sigma**2 if 0 < focal_sigma < np.inf else 0.0
    found = _cluster_sandwich(fit.jacobian, fit.weights, fit.residuals, fit.pixels / size_px, 0.0, prior)
    return found * ALIGNMENT_SCALE**2


def agreement_scale(agreement: np.ndarray | float, slope: float | None = None) -> np.ndarray:
    """Return the factor on sigmas for an agreement between render and photo, relative to an agreement of 0.5.

    A low agreement is due to distant or unobserved surfaces. Their errors are correlated over many pixels, so residuals
    do not reveal them.

    Args:
        agreement: agreement of the last direct alignment, in [0, 1].
        slope: used instead of `AGREEMENT_SLOPE`.
    """
    return np.exp((AGREEMENT_SLOPE if slope is None else slope) * (0.5 - np.asarray(agreement)))


def add_model_error(covariance: np.ndarray) -> np.ndarray:
    """Return the (6, 6) covariance of a pose, increased by the errors of the map that leave no residuals."""
    sigmas = np.r_[np.full(3, MODEL_SIGMA_RAD), np.full(3, MODEL_SIGMA_M)]
    out: np.ndarray = (covariance + covariance.T) / 2 + np.diag(sigmas**2)
    return out


def _cluster_sandwich(
    J: np.ndarray, weights: np.ndarray, r: np.ndarray, at: np.ndarray, min_variance: float, focal: float
) -> np.ndarray:
    """Return the (dim, dim) cluster-robust sandwich covariance; blocks of the photo are the clusters (Liang and Zeger
    1986).

    It is shrunk towards the covariance of independent residuals, because there are few blocks.

    Args:
        J: (K, C, dim) derivatives of the residuals.
        weights, r: (K, C) weights and residuals.
        at: (K, 2) positions as shares of the photo's width and height.
        min_variance: lower limit of the variance of a residual.
        focal: prior information on the focal length.
    """
    dim = J.shape[2]
    information = np.einsum("kcd,kc,kce->de", J, weights, J, optimize=True)
    if dim == 7:
        information[6, 6] += focal
    inverse = np.linalg.pinv(information, hermitian=True)
    scores = np.einsum("kcd,kc,kc->kd", J, weights, r, optimize=True)
    cell = np.clip((at * _BLOCKS).astype(int), 0, np.array(_BLOCKS) - 1)
    block = cell[:, 1] * _BLOCKS[0] + cell[:, 0]
    sums = np.zeros((_BLOCKS[0] * _BLOCKS[1], dim))
    np.add.at(sums, block, scores)
    used = len(np.unique(block))
    clustered = sums.T @ sums * (used / max(used - dim / 2, 1.0))
    # The estimate for independent residuals times the number of residuals per block bounds the clustered estimate,
    # whose sums may be small by chance.
    seen = float((weights * r**2).sum() / max(weights.sum() - dim, 1.0))
    per_block = len(J) / max(used, 1)
    independent = information * max(seen, min_variance) * np.sqrt(per_block)
    share = used / (used + 2.0 * dim)
    middle = share * clustered + (1 - share) * independent
    out: np.ndarray = inverse @ middle @ inverse
    return out


def add_scene_covariance(
    covariance: np.ndarray, T_metric_camera: np.ndarray, scenes: list[tuple[MapScene, float]]
) -> np.ndarray:
    """Add the uncertainty of the poses of the supporting scenes.

    Args:
        covariance: (6, 6) covariance of the pose, in metres.
        scenes: supporting scenes with their shares of the patches. Errors of neighbouring scenes are correlated, so the
            covariances of the scenes are averaged.
    """
    out = covariance.copy()
    total = sum(share for _, share in scenes)
    for scene, share in scenes:
        if scene.covariance is None or total <= 0:
            continue
        out += share / total * _propagate(scene.covariance, scene.S_metric_scene, T_metric_camera)
    return out


def _propagate(covariance: np.ndarray, S_metric_scene: Sim3, T_metric_camera: np.ndarray) -> np.ndarray:
    """Return the (6, 6) covariance of a camera that is fixed to a scene; the scene has a covariance (7, 7) on its own
    side and in its own unit."""
    # Transform by the adjoint of the scene's pose in the camera frame: S Exp(xi) p.
    scale = S_metric_scene.scale
    R = T_metric_camera[:3, :3].T @ S_metric_scene.rotation  # camera from scene
    centre = S_metric_scene.inverse().apply(T_metric_camera[:3, 3])  # the camera in the scene frame
    J = np.zeros((6, 7))
    J[:3, :3] = R
    J[3:, :3] = -scale * R @ skew(centre)
    J[3:, 3:6] = scale * R
    J[3:, 6] = scale * R @ centre
    return J @ covariance @ J.T

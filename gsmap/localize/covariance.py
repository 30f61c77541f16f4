"""How well a photograph's pose is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.geometry.rotations import skew
from gsmap.localize import resection
from gsmap.localize.placed import PlacedFeatures
from gsmap.types import Sim3


@dataclass(frozen=True)
class Params:
    """How residuals become a covariance.

    Args:
        blocks: columns and rows of the picture; residuals within one block err together, for the surfaces that they lie
            on do.
        least_px: no patch is known better than this, at 480 pixels.
        hidden_m: standard deviation of a translation that leaves no residual: the splats of a capture lie beside the
            surface that its photographs show; fitted on made places by ``tools/fit_localize.py``.
        hidden_rad: the same of a rotation.
        swell: by which share the standard deviations that residuals tell are too small on made places.
    """

    blocks: tuple[int, int] = (6, 4)
    least_px: float = 0.15
    hidden_m: float = 0.002
    hidden_rad: float = 0.0005
    swell: float = 1.5


def pose_covariance(
    fit: resection.Refined,
    pixels: np.ndarray,
    size_px: tuple[int, int],
    params: Params,
    *,
    focal_sigma: float = 0.0,
) -> np.ndarray:
    """(6, 6) over [rot_rad, trans] on the camera's side, in the unit of the points, of one photograph's adjustment.

    A sandwich of the information between the scores of blocks of the picture (Liang and Zeger 1986): residuals of one
    block are one measurement, however many patches it holds. Shrunk towards what independent residuals would tell,
    for there are few blocks.

    Args:
        pixels: (K, 2) of the patches.
        focal_sigma: as in `Photo`; where the focal length was solved for, what that costs the pose is in.
    """
    dim = fit.jacobian.shape[2]
    J, r = fit.jacobian, fit.residuals_px
    weights = fit.weights
    information = np.einsum("kid,k,kie->de", J, weights, J)
    if dim == 7 and np.isfinite(focal_sigma) and focal_sigma > 0:
        information[6, 6] += 1 / focal_sigma**2
    inverse = np.linalg.pinv(information, hermitian=True)
    scores = np.einsum("kid,k,ki->kd", J, weights, r)
    at = np.clip((pixels / size_px * params.blocks).astype(int), 0, np.array(params.blocks) - 1)
    block = at[:, 1] * params.blocks[0] + at[:, 0]
    sums = np.zeros((params.blocks[0] * params.blocks[1], dim))
    np.add.at(sums, block, scores)
    used = len(np.unique(block))
    clustered = sums.T @ sums * (used / max(used - dim / 2, 1.0))
    # Each patch alone, at its own noise or at the least there is, times how many lie in a block together: an upper end
    # of what blocks could show had chance not made their sums small.
    seen = float((weights * (r**2).sum(1)).sum() / max(2 * weights.sum() - dim, 1.0))
    noise = max(seen, (params.least_px * max(size_px) / 480) ** 2)
    many = len(pixels) / max(used, 1)
    independent = information * noise * np.sqrt(many)
    share = used / (used + 2.0 * dim)
    middle = share * clustered + (1 - share) * independent
    covariance = (inverse @ middle @ inverse)[:6, :6] * params.swell**2
    hidden = np.r_[np.full(3, params.hidden_rad), np.full(3, params.hidden_m)]
    out: np.ndarray = (covariance + covariance.T) / 2 + np.diag(hidden**2)
    return out


def with_scene(
    covariance: np.ndarray, T_metric_camera: np.ndarray, scenes: list[tuple[PlacedFeatures, float]]
) -> np.ndarray:
    """The same with what is not known of where the scenes lie in the map.

    Args:
        covariance: (6, 6), metres.
        scenes: those that the patches were found in, and their shares of them. Scenes that lie side by side in the map
            err together, so their covariances are averaged and not divided.
    """
    out = covariance.copy()
    total = sum(share for _, share in scenes)
    for scene, share in scenes:
        if scene.covariance is None or total <= 0:
            continue
        out += share / total * _carried(scene.covariance, scene.S_metric_scene, T_metric_camera)
    return out


def _carried(covariance: np.ndarray, S_metric_scene: Sim3, T_metric_camera: np.ndarray) -> np.ndarray:
    """(6, 6) of a camera fixed to a scene whose pose errs (7, 7, on the scene's side and in its unit)."""
    # S Exp(xi) p: seen from the camera, the scene moves it by the adjoint of (scene in camera).
    scale = S_metric_scene.scale
    R = T_metric_camera[:3, :3].T @ S_metric_scene.rotation  # camera from scene
    centre = S_metric_scene.inverse().apply(T_metric_camera[:3, 3])  # the camera's place in the scene
    J = np.zeros((6, 7))
    J[:3, :3] = R
    J[3:, :3] = -scale * R @ skew(centre)
    J[3:, 3:6] = scale * R
    J[3:, 6] = scale * R @ centre
    return J @ covariance @ J.T

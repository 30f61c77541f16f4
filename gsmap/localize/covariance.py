"""How well a photograph's pose is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.geometry.rotations import skew
from gsmap.localize import aligning, resection
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
            surface that its photographs show; fitted on made places by ``tools/fit/localize.py``.
        hidden_rad: the same of a rotation.
        swell: by how many times the standard deviations that residuals of patches tell are too small on made places,
            where a render agrees by one half with the photo.
        swell_aligned: the same of what differences of colours tell.
        disagreeing: where it agrees less or more they are multiplied by exp(disagreeing * (0.5 - agreement)).
        differing: by what poses by patches and by colours differ either may be wrong: so large a share of its square is
            added.
    """

    blocks: tuple[int, int] = (6, 4)
    least_px: float = 0.15
    hidden_m: float = 0.003
    hidden_rad: float = 0.0003
    swell: float = 2.1
    swell_aligned: float = 4.7
    disagreeing: float = 2.0
    differing: float = 0.25


def of_patches(
    fit: resection.Refined, pixels: np.ndarray, size_px: tuple[int, int], params: Params, focal_sigma: float
) -> np.ndarray:
    """(dim, dim) over [rot_rad, trans, log focal length] on the camera's side, in the unit of the points, of what the
    residuals of patches at pixels (K, 2) tell alone.

    Args:
        focal_sigma: as in `Photo`; what a focal length that was solved for costs the pose is in.
    """
    least = (params.least_px * max(size_px) / 480) ** 2
    weights = np.repeat(fit.weights[:, None], 2, axis=1)
    prior = 1 / focal_sigma**2 if 0 < focal_sigma < np.inf else 0.0
    told = _sandwich(fit.jacobian, weights, fit.residuals_px, pixels / size_px, least, prior, params.blocks)
    return told * params.swell**2


def of_aligned(fit: aligning.Aligned, size_px: tuple[int, int], params: Params, focal_sigma: float) -> np.ndarray:
    """(dim, dim) of what the differences of colours tell alone.

    Args:
        size_px: of the picture that it was aligned with.
    """
    noise = float((fit.weights * fit.residuals**2).sum() / max(fit.weights.sum(), 1e-9))
    prior = noise / focal_sigma**2 if 0 < focal_sigma < np.inf else 0.0
    told = _sandwich(fit.jacobian, fit.weights, fit.residuals, fit.pixels / size_px, 0.0, prior, params.blocks)
    return told * params.swell_aligned**2


def doubt_of(agreement: np.ndarray | float, disagreeing: float) -> np.ndarray:
    """By how many times standard deviations are larger than where a render agrees by one half with the photo.

    Where it agrees less the splats show less, from farther away, and where nobody looked from that side: their errors
    are of many pixels together, and residuals do not tell them.

    Args:
        agreement: of the render that was laid over it last, in [0, 1] (`gsmap.localize.aligning.Aligned`).
        disagreeing: of `Params`.
    """
    return np.exp(disagreeing * (0.5 - np.asarray(agreement)))


def with_hidden(told: np.ndarray, params: Params) -> np.ndarray:
    """(6, 6) of a pose of which residuals tell so much, with what leaves none."""
    hidden = np.r_[np.full(3, params.hidden_rad), np.full(3, params.hidden_m)]
    out: np.ndarray = (told + told.T) / 2 + np.diag(hidden**2)
    return out


def _sandwich(
    J: np.ndarray,
    weights: np.ndarray,
    r: np.ndarray,
    at: np.ndarray,
    least: float,
    focal: float,
    blocks: tuple[int, int],
) -> np.ndarray:
    """(dim, dim): the information between the scores of blocks of the picture (Liang and Zeger 1986).

    Residuals of one block are one measurement, however many it holds. Shrunk towards what independent residuals would
    tell, for there are few blocks.

    Args:
        J: (K, C, dim).
        weights, r: (K, C).
        at: (K, 2) shares of the picture's width and height.
        least: variance of a residual, at the least.
        focal: information of the focal length from elsewhere.
        blocks: columns and rows.
    """
    dim = J.shape[2]
    information = np.einsum("kcd,kc,kce->de", J, weights, J, optimize=True)
    if dim == 7:
        information[6, 6] += focal
    inverse = np.linalg.pinv(information, hermitian=True)
    scores = np.einsum("kcd,kc,kc->kd", J, weights, r, optimize=True)
    cell = np.clip((at * blocks).astype(int), 0, np.array(blocks) - 1)
    block = cell[:, 1] * blocks[0] + cell[:, 0]
    sums = np.zeros((blocks[0] * blocks[1], dim))
    np.add.at(sums, block, scores)
    used = len(np.unique(block))
    clustered = sums.T @ sums * (used / max(used - dim / 2, 1.0))
    # Each alone, at its own noise or at the least there is, times how many lie in a block together: an upper end of
    # what blocks could show had chance not made their sums small.
    seen = float((weights * r**2).sum() / max(weights.sum() - dim, 1.0))
    many = len(J) / max(used, 1)
    independent = information * max(seen, least) * np.sqrt(many)
    share = used / (used + 2.0 * dim)
    middle = share * clustered + (1 - share) * independent
    out: np.ndarray = inverse @ middle @ inverse
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

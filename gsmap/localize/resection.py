"""A camera's pose from points that it sees: LO-RANSAC, then least squares that doubts what is far off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.geometry.projection import project
from gsmap.geometry.rotations import exp_so3, skew
from gsmap.geometry.similarities import rotation_vectors

_FOCAL_KNOWN = 0.01  # standard deviation of the logarithm of a focal length that is taken as it is


@dataclass(frozen=True)
class Params:
    """How a pose is found among wrong matches.

    Args:
        max_error_px: of an inlier, at a picture of 480 pixels; in proportion to its longer side.
        max_trials: samples of three matches at most.
        min_inliers: different features of the photo, for a pose to be looked into at all ...
        min_agreeing: ... and where each also says about how the camera was turned.
        max_turn_deg: by how much that may be otherwise than the pose.
        turns: how many ways that the camera may have been turned are tried, those that most features say first.
        same_m, same_deg: poses that are nearer to each other are one candidate.
        doubt_px: residuals count less from about here on while the pose is refined.
        iterations: of that.
    """

    max_error_px: float = 6.0
    max_trials: int = 6000
    min_inliers: int = 6
    min_agreeing: int = 4
    max_turn_deg: float = 30.0
    turns: int = 10
    same_m: float = 0.4
    same_deg: float = 12.0
    doubt_px: float = 1.5
    iterations: int = 12


@dataclass(frozen=True, eq=False)
class Resection:
    """A camera's pose, and what speaks for it.

    Args:
        T_map_camera: (4, 4).
        intrinsics_px: (4,).
        inliers: (K,) bool, of the matches that were given.
    """

    T_map_camera: np.ndarray
    intrinsics_px: np.ndarray
    inliers: np.ndarray


def is_free(focal_sigma: float) -> bool:
    """Whether a focal length that is known so well (as in `Photo`) is solved for."""
    return focal_sigma > _FOCAL_KNOWN


def fewest(focal_sigma: float, params: Params) -> int:
    """How many features must agree on a pose, and say that the camera was turned so, for it to be looked into: four fix
    one of an unknown focal length, whatever they are."""
    return params.min_inliers if is_free(focal_sigma) else params.min_agreeing


def resect(
    pixels: np.ndarray,
    points: np.ndarray,
    intrinsics_px: np.ndarray,
    size_px: tuple[int, int],
    focal_sigma: float,
    params: Params,
) -> Resection | None:
    """The pose that most matches agree with, by LO-RANSAC (Chum et al. 2003); None where too few agree with any.

    Args:
        pixels: (K, 2) in the photo.
        points: (K, 3) map.
        focal_sigma: as in `Photo`; see `is_free`.
    """
    import pycolmap

    if len(pixels) < 4:
        return None
    fx, fy, cx, cy = intrinsics_px
    free = is_free(focal_sigma)
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE" if free else "PINHOLE",
        width=size_px[0],
        height=size_px[1],
        params=[(fx + fy) / 2, cx, cy] if free else [fx, fy, cx, cy],
    )
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.estimate_focal_length = free
    options.ransac.max_error = params.max_error_px * max(size_px) / 480
    options.ransac.max_num_trials = params.max_trials
    # As many trials as find a pose that so few agree with; where matches are few, that is soon.
    options.ransac.min_inlier_ratio = max(0.01, min(params.min_inliers / len(pixels), 1.0))
    options.ransac.confidence = 0.9999
    options.ransac.random_seed = 1
    found = pycolmap.estimate_absolute_pose(pixels.astype(np.float64), points.astype(np.float64), camera, options)
    if found is None:
        return None
    inliers = np.asarray(found["inlier_mask"], bool)
    if len(np.unique(pixels[inliers], axis=0)) < params.min_inliers:
        return None
    if free:
        focal = float(camera.params[0])
        intrinsics_px = np.array([focal, focal, cx, cy])
    pose = np.eye(4)
    pose[:3] = found["cam_from_world"].matrix()
    return Resection(np.linalg.inv(pose), np.asarray(intrinsics_px, float), inliers)


def agreeing(
    pixels: np.ndarray,
    points: np.ndarray,
    T_map_camera: np.ndarray,
    intrinsics_px: np.ndarray,
    size_px: tuple[int, int],
    params: Params,
) -> np.ndarray:
    """(K,) bool: matches within the bar of a pose."""
    at, depth = project(points, np.linalg.inv(T_map_camera), intrinsics_px)
    bar = params.max_error_px * max(size_px) / 480
    out: np.ndarray = (depth > 0) & (np.linalg.norm(at - pixels, axis=1) < bar)
    return out


@dataclass(frozen=True, eq=False)
class Refined:
    """A pose by least squares.

    Args:
        T_map_camera, intrinsics_px: the answer.
        residuals_px: (K, 2) found less predicted.
        weights: (K,) of Cauchy's loss at the answer, times those that were given.
        jacobian: (K, 2, 6 or 7) of the prediction by [rot_rad, trans] on the camera's side, and the log of the focal
            length where it was free.
    """

    T_map_camera: np.ndarray
    intrinsics_px: np.ndarray
    residuals_px: np.ndarray
    weights: np.ndarray
    jacobian: np.ndarray


def refine(
    pixels: np.ndarray,
    points: np.ndarray,
    T_map_camera: np.ndarray,
    intrinsics_px: np.ndarray,
    params: Params,
    *,
    weights: np.ndarray | None = None,
    focal: tuple[float, float] | None = None,
) -> Refined:
    """Minimise robust reprojection errors over the pose, and the focal length if it is free (Gauss-Newton).

    Args:
        pixels: (K, 2).
        points: (K, 3) map.
        weights: (K,) of the matches.
        focal: its expected value and ``focal_sigma``, where it is free.
    """
    pose, intrinsics = T_map_camera.copy(), intrinsics_px.astype(float).copy()
    given = np.ones(len(pixels)) if weights is None else weights
    dim = 6 if focal is None else 7
    damping = 1e-6
    residuals, jacobian = linearised(pixels, points, pose, intrinsics, dim)
    for _ in range(params.iterations):
        robust = given * doubted(residuals, params.doubt_px)
        J, w = jacobian.reshape(-1, dim), np.repeat(robust, 2)
        A, b = (J.T * w) @ J, J.T @ (w * residuals.ravel())
        cost = _cost(residuals, given, params, intrinsics, focal)
        if focal is not None and np.isfinite(focal[1]):
            A[6, 6] += 1.0 / focal[1] ** 2
            b[6] += np.log(focal[0] / intrinsics[0]) / focal[1] ** 2
        step = np.linalg.solve(A + damping * np.diag(np.diag(A)) + 1e-12 * np.eye(dim), b)
        tried, lens = moved(pose, step[:6]), intrinsics.copy()
        if focal is not None:
            lens[:2] *= np.exp(np.clip(step[6], -0.3, 0.3))
        after, J_after = linearised(pixels, points, tried, lens, dim)
        if _cost(after, given, params, lens, focal) > cost:
            damping = max(damping * 100, 1e-3)
            if damping > 1e3:
                break
            continue
        pose, intrinsics, residuals, jacobian, damping = tried, lens, after, J_after, damping / 10
        if np.abs(step[:3]).max() < 1e-7 and np.abs(step[3:6]).max() < 1e-7 * (1 + np.abs(pose[:3, 3]).max()):
            break
    return Refined(pose, intrinsics, residuals, given * doubted(residuals, params.doubt_px), jacobian)


def moved(T_map_camera: np.ndarray, xi: np.ndarray) -> np.ndarray:
    """``T Exp(xi)`` of xi = [rot_rad (3), trans (3)], on the camera's side as `gsmap.geometry.rotations.retract`."""
    out = np.eye(4)
    out[:3, :3] = T_map_camera[:3, :3] @ exp_so3(xi[:3])
    u, _, vt = np.linalg.svd(out[:3, :3])
    out[:3, :3] = u @ vt
    out[:3, 3] = T_map_camera[:3, 3] + T_map_camera[:3, :3] @ xi[3:6]
    return out


def moved_by(T_map_camera: np.ndarray, to: np.ndarray) -> np.ndarray:
    """(6,) the xi by which `moved` takes a pose to another one."""
    apart = np.linalg.inv(T_map_camera) @ to
    return np.r_[rotation_vectors(apart[:3, :3])[0], apart[:3, 3]]


def linearised(
    pixels: np.ndarray, points: np.ndarray, pose: np.ndarray, intrinsics: np.ndarray, dim: int
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (K, 2) and the prediction's derivative (K, 2, dim); what lies behind the camera counts for nothing."""
    fx, fy, cx, cy = intrinsics
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    z = local[:, 2]
    front = z > 1e-6
    z = np.where(front, z, 1.0)
    x, y = local[:, 0] / z, local[:, 1] / z
    residuals = pixels - np.stack([fx * x + cx, fy * y + cy], axis=1)
    by_point = np.zeros((len(points), 2, 3))
    by_point[:, 0, 0], by_point[:, 0, 2] = fx / z, -fx * x / z
    by_point[:, 1, 1], by_point[:, 1, 2] = fy / z, -fy * y / z
    # local' = Exp(-w) local - v: a turn of the camera moves what it sees the other way.
    jacobian = np.zeros((len(points), 2, dim))
    jacobian[:, :, :3] = by_point @ skew(local)
    jacobian[:, :, 3:6] = -by_point
    if dim == 7:
        jacobian[:, 0, 6], jacobian[:, 1, 6] = fx * x, fy * y
    residuals[~front] = 0
    jacobian[~front] = 0
    return residuals, jacobian


def doubted(residuals: np.ndarray, scale_px: float) -> np.ndarray:
    """(K,) weights of Cauchy's loss: a match that is far off says little."""
    out: np.ndarray = 1 / (1 + (residuals**2).sum(1) / scale_px**2)
    return out


def _cost(
    residuals: np.ndarray, given: np.ndarray, params: Params, intrinsics: np.ndarray, focal: tuple[float, float] | None
) -> float:
    """What is minimised; a weight of one is a match that is known to a pixel."""
    scale = params.doubt_px**2
    cost = scale * (given * np.log1p((residuals**2).sum(1) / scale)).sum()
    if focal is not None and np.isfinite(focal[1]):
        cost += (np.log(focal[0] / intrinsics[0]) / focal[1]) ** 2
    return float(cost)

"""Estimate a camera pose from 2D-3D correspondences: resection by LO-RANSAC, then robust least squares."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.geometry.camera_models import require_pycolmap
from gsmap.geometry.projection import project
from gsmap.geometry.rotations import exp_so3, skew
from gsmap.geometry.similarities import rotation_vectors

MAX_ERROR_PX = 6.0
"""Largest reprojection error of an inlier, for a photo of 480 pixels; it scales with the longer side."""

MIN_INLIERS, MIN_INLIERS_FREE_FOCAL = 4, 6
"""Smallest number of different features of a photo that must agree; four features always fit a pose with a free focal
length."""

ROBUST_SCALE_PX = 1.5
"""Scale of Cauchy's loss in the least squares."""

ITERATIONS = 12
"""Maximum number of Gauss-Newton steps."""

_MAX_TRIALS = 6000  # of RANSAC
_FIXED_FOCAL_SIGMA = 0.01  # a log focal length with a smaller standard deviation is not estimated


@dataclass(frozen=True, eq=False)
class Resection:
    """A camera pose estimated by RANSAC.

    Args:
        T_map_camera: (4, 4) pose.
        intrinsics_px: (4,) ``fx fy cx cy``.
        inliers: (K,) mask of the matches that agree with the pose.
    """

    T_map_camera: np.ndarray
    intrinsics_px: np.ndarray
    inliers: np.ndarray


def is_free(focal_sigma: float) -> bool:
    """Return whether a focal length with this uncertainty (as in `Photo`) is estimated."""
    return focal_sigma > _FIXED_FOCAL_SIGMA


def min_inliers(focal_sigma: float) -> int:
    """Return the number of features that must agree on a pose and its orientation."""
    return MIN_INLIERS_FREE_FOCAL if is_free(focal_sigma) else MIN_INLIERS


def resect(
    pixels: np.ndarray,
    points: np.ndarray,
    intrinsics_px: np.ndarray,
    size_px: tuple[int, int],
    focal_sigma: float,
    *,
    min_inliers: int = MIN_INLIERS_FREE_FOCAL,
) -> Resection | None:
    """Estimate the pose with most inliers by LO-RANSAC (Chum et al. 2003); return None with too few inliers.

    Args:
        pixels: (K, 2) positions in the photo.
        points: (K, 3) positions in the map.
        focal_sigma: as in `Photo`; see `is_free`.
    """
    if len(pixels) < 4:
        return None
    pycolmap = require_pycolmap()
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
    options.ransac.max_error = MAX_ERROR_PX * max(size_px) / 480
    options.ransac.max_num_trials = _MAX_TRIALS
    # The number of trials that a pose with so few inliers needs; it is small with few matches.
    options.ransac.min_inlier_ratio = max(0.01, min(min_inliers / len(pixels), 1.0))
    options.ransac.confidence = 0.9999
    options.ransac.random_seed = 1
    found = pycolmap.estimate_absolute_pose(pixels.astype(np.float64), points.astype(np.float64), camera, options)
    if found is None:
        return None
    inliers = np.asarray(found["inlier_mask"], bool)
    if len(np.unique(pixels[inliers], axis=0)) < min_inliers:
        return None
    if free:
        focal = float(camera.params[0])
        intrinsics_px = np.array([focal, focal, cx, cy])
    pose = np.eye(4)
    pose[:3] = found["cam_from_world"].matrix()
    return Resection(np.linalg.inv(pose), np.asarray(intrinsics_px, float), inliers)


def find_inliers(
    pixels: np.ndarray,
    points: np.ndarray,
    T_map_camera: np.ndarray,
    intrinsics_px: np.ndarray,
    size_px: tuple[int, int],
) -> np.ndarray:
    """Return a (K,) mask of matches within `MAX_ERROR_PX` of their projection."""
    at, depth = project(points, np.linalg.inv(T_map_camera), intrinsics_px)
    bar = MAX_ERROR_PX * max(size_px) / 480
    out: np.ndarray = (depth > 0) & (np.linalg.norm(at - pixels, axis=1) < bar)
    return out


@dataclass(frozen=True, eq=False)
class LeastSquaresPose:
    """A pose estimated by least squares.

    Args:
        T_map_camera, intrinsics_px: the estimate.
        residuals_px: (K, 2) measured minus predicted.
        weights: (K,) weights of Cauchy's loss at the estimate, times the given weights.
        jacobian: (K, 2, 6 or 7) derivatives of the prediction with respect to [rot_rad, trans] on the camera's side,
            and to the log focal length if it is estimated.
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
    *,
    weights: np.ndarray | None = None,
    focal: tuple[float, float] | None = None,
) -> LeastSquaresPose:
    """Minimize robust reprojection errors over the pose, and the focal length if it is free (Gauss-Newton).

    Args:
        pixels: (K, 2) positions in the photo.
        points: (K, 3) positions in the map.
        weights: (K,) weights of the matches.
        focal: expected focal length and ``focal_sigma``; None if the focal length is not estimated.
    """
    pose, intrinsics = T_map_camera.copy(), intrinsics_px.astype(float).copy()
    given = np.ones(len(pixels)) if weights is None else weights
    dim = 6 if focal is None else 7
    damping = 1e-6
    residuals, jacobian = linearize(pixels, points, pose, intrinsics, dim)
    for _ in range(ITERATIONS):
        robust = given * robust_weights(residuals)
        J, w = jacobian.reshape(-1, dim), np.repeat(robust, 2)
        A, b = (J.T * w) @ J, J.T @ (w * residuals.ravel())
        cost = _cost(residuals, given, intrinsics, focal)
        if focal is not None and np.isfinite(focal[1]):
            A[6, 6] += 1.0 / focal[1] ** 2
            b[6] += np.log(focal[0] / intrinsics[0]) / focal[1] ** 2
        step = np.linalg.solve(A + damping * np.diag(np.diag(A)) + 1e-12 * np.eye(dim), b)
        next_pose, lens = retract_pose(pose, step[:6]), intrinsics.copy()
        if focal is not None:
            lens[:2] *= np.exp(np.clip(step[6], -0.3, 0.3))
        after, J_after = linearize(pixels, points, next_pose, lens, dim)
        if _cost(after, given, lens, focal) > cost:
            damping = max(damping * 100, 1e-3)
            if damping > 1e3:
                break
            continue
        pose, intrinsics, residuals, jacobian, damping = next_pose, lens, after, J_after, damping / 10
        if np.abs(step[:3]).max() < 1e-7 and np.abs(step[3:6]).max() < 1e-7 * (1 + np.abs(pose[:3, 3]).max()):
            break
    return LeastSquaresPose(pose, intrinsics, residuals, given * robust_weights(residuals), jacobian)


def retract_pose(T_map_camera: np.ndarray, xi: np.ndarray) -> np.ndarray:
    """Return ``T Exp(xi)`` for xi = [rot_rad (3), trans (3)] on the camera's side."""
    out = np.eye(4)
    out[:3, :3] = T_map_camera[:3, :3] @ exp_so3(xi[:3])
    u, _, vt = np.linalg.svd(out[:3, :3])
    out[:3, :3] = u @ vt
    out[:3, 3] = T_map_camera[:3, 3] + T_map_camera[:3, :3] @ xi[3:6]
    return out


def relative_xi(T_map_camera: np.ndarray, to: np.ndarray) -> np.ndarray:
    """Return the (6,) xi by which `retract_pose` moves a pose to another pose."""
    apart = np.linalg.inv(T_map_camera) @ to
    return np.r_[rotation_vectors(apart[:3, :3])[0], apart[:3, 3]]


def linearize(
    pixels: np.ndarray, points: np.ndarray, pose: np.ndarray, intrinsics: np.ndarray, dim: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the residuals (K, 2) and the derivatives of the prediction (K, 2, dim); both are 0 for points behind the
    camera."""
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
    # local' = Exp(-w) local - v: points move opposite to the camera.
    jacobian = np.zeros((len(points), 2, dim))
    jacobian[:, :, :3] = by_point @ skew(local)
    jacobian[:, :, 3:6] = -by_point
    if dim == 7:
        jacobian[:, 0, 6], jacobian[:, 1, 6] = fx * x, fy * y
    residuals[~front] = 0
    jacobian[~front] = 0
    return residuals, jacobian


def robust_weights(residuals: np.ndarray) -> np.ndarray:
    """Return the (K,) weights of Cauchy's loss."""
    out: np.ndarray = 1 / (1 + (residuals**2).sum(1) / ROBUST_SCALE_PX**2)
    return out


def _cost(residuals: np.ndarray, given: np.ndarray, intrinsics: np.ndarray, focal: tuple[float, float] | None) -> float:
    """Return the cost, in which a match of weight one has a standard deviation of a pixel."""
    scale = ROBUST_SCALE_PX**2
    cost = scale * (given * np.log1p((residuals**2).sum(1) / scale)).sum()
    if focal is not None and np.isfinite(focal[1]):
        cost += (np.log(focal[0] / intrinsics[0]) / focal[1]) ** 2
    return float(cost)

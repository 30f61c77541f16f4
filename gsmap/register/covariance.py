"""How well a refined pose is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.geometry.rotations import skew
from gsmap.register.surface import Surface
from gsmap.types import Sim3


@dataclass(frozen=True)
class Params:
    """How well a refined pose is known.

    Args:
        radius_m: pairs farther apart than this are not counted.
        cell_m: residuals within a cell of this size are taken to share their error; cells are independent.
        floor_m: error of a cell that no residual shows (a trainer's bias, a sensor's distortion): many cells average
            it out, and over the overlap's radius it turns and scales the pose.
        factor: on the sandwich, from measured normalised errors and triangles (``tools/bench_register.py`` prints
            them).
        scale_factor: on the scale's own variance, from measured errors of scales: those of a real sensor's captures
            differ by up to a percent of themselves, which leaves no residual.
    """

    radius_m: float = 0.08
    cell_m: float = 1.0
    floor_m: float = 0.01
    factor: float = 2.0
    scale_factor: float = 4.0


# A rigid edge knows its scale: a row this stiff keeps the matrix 7 x 7 without letting the scale move.
_RIGID_LOG_SCALE_SIGMA = 1e-6


def pose_covariance(
    target: Surface, source: Surface, pose: Sim3, params: Params | None = None, *, with_scale: bool = False
) -> tuple[np.ndarray, tuple[float, float, float]] | None:
    """Covariance of a refined pose, in metres; None where too little overlaps.

    An ICP Hessian is overconfident 10 to 900 times on splats, for neighbouring points share their error. So: the
    sandwich ``H^-1 (sum over cells of g g^T) H^-1`` of the point-to-plane problem, where each cell's gradient g counts
    once, times a factor, plus a floor at the overlap's centroid moved to the source's frame. C cells that fit D
    parameters show too little of their error: ``C / (C - D)`` makes up for it, as with residuals of any regression.

    Returns:
        The (7, 7) matrix over [rot_rad, trans, log_scale] applied on the source side, and the standard deviations
        (rad, metres, log scale) of the least known rotation, translation and scale at the overlap's centroid.
    """
    params = params or Params()
    points, _ = source.coarse
    moved = pose.apply(points)
    distance, row = target.nearest(moved, params.radius_m)
    hit = np.flatnonzero(np.isfinite(distance))
    if len(hit) < 20:
        return None
    normals = target.normals[row[hit]]
    residual = (normals * (moved[hit] - target.coarse[0][row[hit]])).sum(1)
    jacobian = point_to_plane_jacobian(pose, points[hit], normals)
    dim = 7 if with_scale else 6
    jacobian = jacobian[:, :dim]
    # Work about the overlap's centroid: rotation and translation then hardly mix and the matrices are well scaled.
    centroid = points[hit].mean(0)
    to_centroid = _shift(centroid)[:dim, :dim]
    jacobian = jacobian @ np.linalg.inv(to_centroid)
    hessian = jacobian.T @ jacobian + 1e-9 * np.trace(jacobian.T @ jacobian) / dim * np.eye(dim)
    _, cell = np.unique(np.floor(moved[hit] / params.cell_m).astype(int), axis=0, return_inverse=True)
    cells = int(cell.max()) + 1
    gradient = np.zeros((cells, dim))
    np.add.at(gradient, cell.ravel(), jacobian * residual[:, None])
    inverse = np.linalg.inv(hessian)
    sandwich = inverse @ (gradient.T @ gradient) @ inverse * (cells / max(cells - dim, 1))
    spread = points[hit] - points[hit].mean(0)
    radius = float(np.sqrt((spread**2).sum(1).mean()))
    shift = params.floor_m / np.sqrt(cells)
    turn = shift / max(radius * pose.scale, 1e-6)
    floor = np.r_[np.full(3, turn), np.full(3, shift / pose.scale), turn]
    covariance = np.diag(np.r_[floor[:6], _RIGID_LOG_SCALE_SIGMA] ** 2)
    covariance[:dim, :dim] = params.factor * sandwich + np.diag(floor[:dim] ** 2)
    if with_scale:
        covariance[6, 6] *= params.scale_factor
    sigmas = (
        float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])),
        float(np.sqrt(np.linalg.eigvalsh(covariance[3:6, 3:6])[-1])) * pose.scale,
        float(np.sqrt(covariance[6, 6])),
    )
    back = np.eye(7)
    back[:dim, :dim] = np.linalg.inv(to_centroid)
    covariance = back @ covariance @ back.T
    return 0.5 * (covariance + covariance.T), sigmas


def in_scene_units(covariance: np.ndarray, source_unit_m: float) -> np.ndarray:
    """The covariance with translations in the source's own unit instead of metres."""
    scale = np.r_[np.ones(3), np.full(3, 1.0 / source_unit_m), 1.0]
    return covariance * scale[:, None] * scale


def point_to_plane_jacobian(pose: Sim3, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(N, 7) derivative of ``n . (S Exp(xi) p)`` at xi = 0; points in the source's frame, normals in the target's."""
    local = pose.scale * normals @ pose.rotation
    return np.concatenate([np.cross(points, local), local, (local * points).sum(1, keepdims=True)], axis=1)


def _shift(centroid: np.ndarray) -> np.ndarray:
    """(7, 7) map of a tangent at the source's origin to the same motion about ``centroid``.

    ``Exp(xi) p = p + w x p + v + l p``; about c: ``v_c = v + w x c + l c``.
    """
    out = np.eye(7)
    out[3:6, :3] = -skew(centroid)
    out[3:6, 6] = centroid
    return out

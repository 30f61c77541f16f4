"""Transform Gaussians (with their spherical harmonics) and cameras to another frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmap.errors import InputError
from gsmap.geometry.directions import fibonacci_sphere
from gsmap.geometry.origins import centred
from gsmap.geometry.rotations import matrices_to_quats, multiply_quats
from gsmap.geometry.sh import SH_C0
from gsmap.types import Cameras, Gaussians, Sim3

_MAX_SH_DEGREE = 3


def transform_gaussians(gaussians: Gaussians, S_a_b: Sim3) -> Gaussians:
    """Transform Gaussians from frame b to frame a.

    The transform is exact: ``mean' = s R mean + t``, ``covariance' = s^2 R covariance R^T``, opacity unchanged, and
    spherical harmonics rotated band by band, so that the colour along ``R d`` is the former colour along ``d``. The
    origin of the Gaussians is transformed as well.
    """
    quat = matrices_to_quats(S_a_b.rotation)
    origin = np.zeros(3)
    if gaussians.origin.any():
        origin = S_a_b.apply(gaussians.origin)
        S_a_b = Sim3(S_a_b.rotation, np.zeros(3), S_a_b.scale)
    return Gaussians(
        S_a_b.apply(gaussians.means),
        multiply_quats(quat.astype(np.float32), gaussians.quats),
        gaussians.log_scales + np.float32(np.log(S_a_b.scale)),
        gaussians.logit_opacities,
        rotate_sh(gaussians.sh, S_a_b.rotation),
        origin,
    )


def transform_with_origin(gaussians: Gaussians, S_a_b: Sim3) -> Gaussians:
    """Transform Gaussians, and give them an origin if float32 cannot represent their positions in frame a."""
    means, origin = centred(S_a_b.apply(gaussians.positions))
    return replace(transform_gaussians(gaussians, S_a_b), means=means, origin=origin)


def transform_cameras(cameras: Cameras, S_a_b: Sim3) -> Cameras:
    """Transform cameras from frame b to frame a; images and intrinsics do not change, depths are multiplied by the
    scale."""
    T_a_camera = transform_poses(cameras.T_frame_camera, S_a_b)
    return replace(cameras, T_frame_camera=T_a_camera, notes=())


def transform_poses(T_b_c: np.ndarray, S_a_b: Sim3) -> np.ndarray:
    """Transform rigid poses (..., 4, 4) from frame b to frame a, in the unit of a."""
    T_a_c = np.array(T_b_c, np.float64)
    T_a_c[..., :3, :3] = S_a_b.rotation @ T_a_c[..., :3, :3]
    T_a_c[..., :3, 3] = S_a_b.apply(T_a_c[..., :3, 3])
    return T_a_c


def rotate_sh(sh: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Rotate the functions with spherical harmonics (N, K, 3) float32 by ``rotation`` (3, 3)."""
    sh = np.ascontiguousarray(sh, dtype=np.float32)
    n, k, _ = sh.shape
    if k == 1:
        return sh
    # One matrix product over the flattened coefficients is far faster than N small ones.
    matrix = np.kron(sh_rotation_matrix(rotation, round(k**0.5) - 1).T, np.eye(3)).astype(np.float32)
    return (sh.reshape(n, k * 3) @ matrix).reshape(n, k, 3)


def sh_rotation_matrix(rotation: np.ndarray, degree: int) -> np.ndarray:
    """Return the real Wigner matrix M (K, K) float64, block diagonal, for which ``f(R^T d) = Y(d) @ M @ c`` if
    ``f = Y @ c``.

    Each band is closed under rotation, so its block follows exactly from the basis at a set of fixed directions and at
    the same directions rotated back.
    """
    directions = fibonacci_sphere(4 * (degree + 1) ** 2)
    basis = sh_basis(directions, degree)
    rotated = sh_basis(directions @ np.asarray(rotation, dtype=np.float64), degree)
    matrix = np.zeros((basis.shape[1],) * 2)
    for band in range(degree + 1):
        at = slice(band**2, (band + 1) ** 2)
        matrix[at, at] = np.linalg.lstsq(basis[:, at], rotated[:, at], rcond=None)[0]
    return matrix


def sh_basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """Evaluate the real spherical harmonics (N, (degree + 1)^2) float64 at unit directions (N, 3).

    Order and signs are those of 3DGS trainers (degree 1 is ``-y, z, -x``).
    """
    if not 0 <= degree <= _MAX_SH_DEGREE:
        raise InputError(f"SH degree must be 0 to {_MAX_SH_DEGREE}, got {degree}", code="unsupported_sh_degree")
    x, y, z = np.asarray(directions, dtype=np.float64).T
    xx, yy, zz = x * x, y * y, z * z
    basis = [
        np.full_like(x, SH_C0),
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * zz - xx - yy),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * zz - xx - yy),
        0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        -0.4570457994644658 * x * (4 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy),
    ]
    return np.stack(basis[: (degree + 1) ** 2], axis=1)

"""Convert rotations between quaternions (``wxyz``) and matrices, and compute exponentials on SO(3) and Sim(3)."""

from __future__ import annotations

import numpy as np

from gsmap.types import Sim3


def quats_to_matrices(quats: np.ndarray) -> np.ndarray:
    """Return the rotation matrices (..., 3, 3) of quaternions (..., 4) ``wxyz``, which are normalized first; zero gives
    the identity."""
    q = np.asarray(quats, dtype=np.float64)
    norm = np.linalg.norm(q, axis=-1, keepdims=True)
    q = np.where(norm > 0, q / np.where(norm > 0, norm, 1.0), [1.0, 0.0, 0.0, 0.0])
    w, x, y, z = np.moveaxis(q, -1, 0)
    out = np.empty((*q.shape[:-1], 3, 3))
    out[..., 0, 0] = 1 - 2 * (y * y + z * z)
    out[..., 0, 1] = 2 * (x * y - w * z)
    out[..., 0, 2] = 2 * (x * z + w * y)
    out[..., 1, 0] = 2 * (x * y + w * z)
    out[..., 1, 1] = 1 - 2 * (x * x + z * z)
    out[..., 1, 2] = 2 * (y * z - w * x)
    out[..., 2, 0] = 2 * (x * z - w * y)
    out[..., 2, 1] = 2 * (y * z + w * x)
    out[..., 2, 2] = 1 - 2 * (x * x + y * y)
    return out


def matrices_to_quats(matrices: np.ndarray) -> np.ndarray:
    """Return the quaternions (..., 4) ``wxyz`` with w >= 0 of rotation matrices (..., 3, 3)."""
    from scipy.spatial.transform import Rotation

    # Pass a copy, here and below, because not every release of scipy accepts read-only arrays.
    matrices = np.array(matrices, dtype=np.float64)
    xyzw = Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_quat()
    wxyz = xyzw[:, [3, 0, 1, 2]]
    wxyz *= np.where(wxyz[:, :1] < 0, -1.0, 1.0)
    out: np.ndarray = wxyz.reshape(*matrices.shape[:-2], 4)
    return out


def rotation_vector(matrix: np.ndarray) -> np.ndarray:
    """Return the rotation vector (3,), axis times angle in [0, pi] radians, of one rotation matrix, without importing
    SciPy.

    The quaternion is the eigenvector of the largest eigenvalue (Bar-Itzhack 2000), which holds for any angle.
    """
    (a, b, c), (d, e, f), (g, h, i) = np.asarray(matrix, np.float64)
    K = np.array(
        [
            [a - e - i, d + b, g + c, h - f],
            [d + b, e - a - i, h + f, c - g],
            [g + c, h + f, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    x, y, z, w = np.linalg.eigh(K)[1][:, -1]
    axis = np.array([x, y, z]) * (1.0 if w >= 0 else -1.0)
    sine = float(np.linalg.norm(axis))
    return axis * (2.0 * np.arctan2(sine, abs(w)) / sine) if sine > 0 else np.zeros(3)


def conjugate_quats(quats: np.ndarray) -> np.ndarray:
    """Return the (..., 4) conjugates (inverse rotations) of unit ``wxyz`` quaternions."""
    out: np.ndarray = np.asarray(quats) * np.array([1.0, -1.0, -1.0, -1.0])
    return out


def multiply_quats(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the Hamilton product (..., 4) of ``wxyz`` quaternions: the rotation by b followed by that by a."""
    aw, ax, ay, az = np.moveaxis(np.asarray(a), -1, 0)
    bw, bx, by, bz = np.moveaxis(np.asarray(b), -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def skew(vectors: np.ndarray) -> np.ndarray:
    """Return the cross-product matrices (..., 3, 3) of vectors (..., 3)."""
    v = np.asarray(vectors, dtype=np.float64)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def angle_between(a: np.ndarray, b: np.ndarray) -> float:
    """Return the angle of ``a^T b`` in radians; it is exact for small angles (from the chord, not the arc cosine)."""
    chord = np.linalg.norm(np.asarray(a) - np.asarray(b)) / np.sqrt(8.0)
    return float(2.0 * np.arcsin(min(1.0, chord)))


def exp_so3(omega: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) of a rotation vector (3,) in radians."""
    from scipy.spatial.transform import Rotation

    matrix: np.ndarray = Rotation.from_rotvec(np.array(omega, dtype=np.float64)).as_matrix()
    return matrix


def retract(pose: Sim3, xi: np.ndarray) -> Sim3:
    """Return ``pose * Exp(xi)`` for xi = [rot_rad (3), trans (3), log_scale], to first order in the coupling of the
    three parts.

    The step is applied in the source frame, as in GTSAM. The result is exact if only one of the three parts is
    non-zero.
    """
    xi = np.asarray(xi, dtype=np.float64)
    scale = float(np.exp(xi[6])) if len(xi) > 6 else 1.0
    return pose @ Sim3(exp_so3(xi[:3]), xi[3:6], scale)

"""Compute with arrays of similarities: composition, exact exponential and logarithm on Sim(3), and adjoint.

A tangent is ``xi = [rot_rad (3), trans (3), log_scale]``, rotation first. ``Exp(xi)`` is the matrix exponential of
``[[skew(rot) + log_scale I, trans], [0, 0]]`` interpreted as ``[sR t; 0
1]``. It is the same map as GTSAM's ``Similarity3.Expmap`` (which stores ``t /
s``) and, with a log scale of zero, as ``Pose3.Expmap``. A perturbation on the source side is ``S_a_b = S_hat_a_b *
Exp(xi)``: it moves points in frame b before they are mapped, so its translation is in b's unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.geometry.rotations import skew
from gsmap.types import Sim3

# Quadrature for the integral of exp(tau (skew(rot) + log_scale I)) over [0, 1]: the integrand is entire, so twelve
# points are exact to machine precision for any rotation up to pi and any scale up to e^2, without series near zero.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)
_NODES, _WEIGHTS = (_NODES + 1) / 2, _WEIGHTS / 2


@dataclass(frozen=True, eq=False)
class Similarities:
    """N similarities as arrays: ``rotations`` (N, 3, 3), ``translations`` (N, 3), ``log_scales`` (N,), float64."""

    rotations: np.ndarray
    translations: np.ndarray
    log_scales: np.ndarray

    @classmethod
    def stack(cls, items: Sequence[Sim3]) -> Similarities:
        n = len(items)
        return cls(
            np.array([s.rotation for s in items]).reshape(n, 3, 3),
            np.array([s.translation for s in items]).reshape(n, 3),
            np.log(np.array([s.scale for s in items], dtype=np.float64)),
        )

    @classmethod
    def identity(cls, count: int) -> Similarities:
        return cls(np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), np.zeros(count))

    def __len__(self) -> int:
        return len(self.log_scales)

    def __getitem__(self, rows: np.ndarray | slice) -> Similarities:
        return Similarities(self.rotations[rows], self.translations[rows], self.log_scales[rows])

    def item(self, row: int) -> Sim3:
        """Return one similarity; its rotation is projected to SO(3)."""
        u, _, vt = np.linalg.svd(self.rotations[row])
        scale = 1.0 if self.log_scales[row] == 0 else float(np.exp(self.log_scales[row]))
        return Sim3(u @ vt, self.translations[row], scale)

    def replaced(self, rows: np.ndarray, values: Similarities) -> Similarities:
        """Return a copy in which ``rows`` are replaced by ``values``."""
        out = Similarities(self.rotations.copy(), self.translations.copy(), self.log_scales.copy())
        out.rotations[rows], out.translations[rows] = values.rotations, values.translations
        out.log_scales[rows] = values.log_scales
        return out

    def inverse(self) -> Similarities:
        rotations = self.rotations.transpose(0, 2, 1)
        translations = -np.einsum("nij,nj->ni", rotations, self.translations) * np.exp(-self.log_scales)[:, None]
        return Similarities(rotations, translations, -self.log_scales)

    def __matmul__(self, other: Similarities) -> Similarities:
        """Return ``S_a_c = S_a_b @ S_b_c`` row by row."""
        moved = np.einsum("nij,nj->ni", self.rotations, other.translations) * np.exp(self.log_scales)[:, None]
        return Similarities(
            self.rotations @ other.rotations, moved + self.translations, self.log_scales + other.log_scales
        )

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Map one point of (N, 3) by each similarity."""
        moved: np.ndarray = np.einsum("nij,nj->ni", self.rotations, points) * np.exp(self.log_scales)[:, None]
        moved = moved + self.translations
        return moved

    def orthonormalised(self) -> Similarities:
        """Project the rotations to SO(3), because long products drift away from it."""
        u, _, vt = np.linalg.svd(self.rotations)
        return Similarities(u @ vt, self.translations, self.log_scales)

    def log(self) -> np.ndarray:
        """Return the (N, 7) tangents for which ``Exp(log) == self``."""
        omega = rotation_vectors(self.rotations)
        trans = np.linalg.solve(_left_factor(omega, self.log_scales), self.translations[:, :, None])[:, :, 0]
        return np.concatenate([omega, trans, self.log_scales[:, None]], axis=1)

    def adjoint(self) -> np.ndarray:
        """Return the (N, 7, 7) adjoints ``Ad`` for which ``S Exp(xi) S^-1 = Exp(Ad xi)``."""
        out = np.zeros((len(self), 7, 7))
        out[:, :3, :3] = self.rotations
        out[:, 3:6, :3] = skew(self.translations) @ self.rotations
        out[:, 3:6, 3:6] = self.rotations * np.exp(self.log_scales)[:, None, None]
        out[:, 3:6, 6] = -self.translations
        out[:, 6, 6] = 1.0
        return out


def exp(xi: np.ndarray) -> Similarities:
    """Return ``Exp`` of tangents (N, 7), or of (N, 6) for rigid transforms."""
    xi = np.asarray(xi, dtype=np.float64)
    log_scales = xi[:, 6] if xi.shape[1] > 6 else np.zeros(len(xi))
    translations = np.einsum("nij,nj->ni", _left_factor(xi[:, :3], log_scales), xi[:, 3:6])
    return Similarities(rotations_of(xi[:, :3]), translations, log_scales)


def commutator(xi: np.ndarray) -> np.ndarray:
    """Return the (N, 7, 7) ``ad`` of tangents (N, 7), the derivative of the adjoint."""
    out = np.zeros((len(xi), 7, 7))
    out[:, :3, :3] = skew(xi[:, :3])
    out[:, 3:6, :3] = skew(xi[:, 3:6])
    out[:, 3:6, 3:6] = out[:, :3, :3] + xi[:, 6, None, None] * np.eye(3)
    out[:, 3:6, 6] = -xi[:, 3:6]
    return out


def rotations_of(omega: np.ndarray) -> np.ndarray:
    """Return the rotation matrices (N, 3, 3) of rotation vectors (N, 3), by Rodrigues' formula."""
    theta = np.linalg.norm(omega, axis=1)
    a = np.sinc(theta / np.pi)
    b = 0.5 * np.sinc(theta / (2 * np.pi)) ** 2
    k = skew(omega)
    out: np.ndarray = np.eye(3) + a[:, None, None] * k + b[:, None, None] * (k @ k)
    return out


def rotation_vectors(matrices: np.ndarray) -> np.ndarray:
    """Return the rotation vectors (N, 3) in radians, of length at most pi, of rotation matrices (N, 3, 3)."""
    from scipy.spatial.transform import Rotation

    out: np.ndarray = Rotation.from_matrix(np.array(matrices, dtype=np.float64).reshape(-1, 3, 3)).as_rotvec()
    return out


def without_scale(information: np.ndarray) -> np.ndarray:
    """Marginalize the scale out of information (..., 7, 7); return (..., 6, 6) on rotation and translation.

    The result is the Schur complement.
    """
    coupling = information[..., :6, 6]
    out: np.ndarray = (
        information[..., :6, :6] - coupling[..., :, None] * coupling[..., None, :] / information[..., 6:, 6:]
    )
    return out


def _left_factor(omega: np.ndarray, log_scales: np.ndarray) -> np.ndarray:
    """Return the (N, 3, 3) ``V`` for which ``t = V trans``: the integral of ``exp(tau (skew(omega) + log_scale I))``
    over [0, 1]."""
    theta = np.linalg.norm(omega, axis=1)[:, None]
    growth = np.exp(log_scales[:, None] * _NODES) * _WEIGHTS
    identity = growth.sum(1)
    first = (growth * _NODES * np.sinc(theta * _NODES / np.pi)).sum(1)
    second = (growth * 0.5 * (_NODES * np.sinc(theta * _NODES / (2 * np.pi))) ** 2).sum(1)
    k = skew(omega)
    out: np.ndarray = identity[:, None, None] * np.eye(3) + first[:, None, None] * k + second[:, None, None] * (k @ k)
    return out

"""Axis conventions of files, and conversion of Gaussians from one convention to another.

A convention is three letters, one per axis: right or left, up or down, front or back. A trained ``.ply`` is ``RDF``,
SPZ is ``RUB``, glTF is ``LUF``. Only the order and signs of coordinates change, so nothing is rounded up to SH
degree 1, and at any degree where the axes keep their order.
"""

from __future__ import annotations

import numpy as np

from gsmap.geometry.transforms import sh_rotation_matrix
from gsmap.types import Gaussians

PLY = "RDF"
SPZ = "RUB"
GLTF = "LUF"

_LETTERS = {"R": (0, 1), "L": (0, -1), "D": (1, 1), "U": (1, -1), "F": (2, 1), "B": (2, -1)}


def axes_matrix(a: str, b: str) -> np.ndarray:
    """Return the signed permutation M (3, 3) float64 with ``x_a = M x_b`` for points in conventions a and b."""
    return _from_letters(a).T @ _from_letters(b)


def change_axes(gaussians: Gaussians, a: str, b: str) -> Gaussians:
    """Convert Gaussians from convention b to convention a; either convention may be mirrored."""
    M = axes_matrix(a, b)
    if np.array_equal(M, np.eye(3)):
        return gaussians
    # Covariance M R S^2 R^T M^T = (M R M^T) (M S^2 M^T) (...)^T: a rotation again, with scales in the new order.
    order = np.abs(M).argmax(1)
    signs = M[range(3), order].astype(np.float32)
    turned = np.linalg.det(M).round().astype(np.float32) * signs
    quats = np.concatenate([gaussians.quats[:, :1], gaussians.quats[:, 1 + order] * turned], axis=1)
    return Gaussians(
        gaussians.means[:, order] * signs,
        quats,
        gaussians.log_scales[:, order],
        gaussians.logit_opacities,
        _turn_sh(gaussians.sh, M),
        M @ gaussians.origin,
    )


def _turn_sh(sh: np.ndarray, M: np.ndarray) -> np.ndarray:
    degree = round(sh.shape[1] ** 0.5) - 1
    if degree == 0:
        return sh
    matrix = sh_rotation_matrix(M, degree)
    near = np.round(matrix)
    if np.abs(matrix - near).max() < 1e-9 and (np.abs(near).sum(1) == 1).all():  # signs and order only
        order = np.abs(near).argmax(1)
        signs = near[range(len(near)), order].astype(np.float32)[:, None]
        return sh * signs if np.array_equal(order, range(len(order))) else sh[:, order] * signs
    return np.einsum("ij,njc->nic", matrix.astype(np.float32), sh, optimize=True)


def _from_letters(convention: str) -> np.ndarray:
    """Return the axes of a convention as columns of a matrix, in right-down-front coordinates."""
    out = np.zeros((3, 3))
    for column, letter in enumerate(convention):
        row, sign = _LETTERS[letter]
        out[row, column] = sign
    return out

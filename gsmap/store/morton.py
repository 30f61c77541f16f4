"""Rows in the order of a space-filling curve, so that neighbours in space are neighbours on disk."""

from __future__ import annotations

import numpy as np

from gsmap.geometry.rotations import quats_to_matrices
from gsmap.types import Gaussians

_BITS = 21  # three axes fill 63 bits


def morton_order(points: np.ndarray) -> np.ndarray:
    """(N,) permutation that sorts points (N, 3) along the Z-order curve of their box; ties keep their order."""
    if not len(points):
        return np.zeros(0, np.int64)
    low, high = points.min(0).astype(np.float64), points.max(0).astype(np.float64)
    step = np.maximum(high - low, np.finfo(np.float32).tiny) / ((1 << _BITS) - 1)
    code = np.zeros(len(points), np.uint64)
    for axis in range(3):
        cell = ((points[:, axis] - low[axis]) / step[axis]).astype(np.uint64)
        code |= _spread(cell) << np.uint64(axis)
    return np.argsort(code, kind="stable")


def chunk_boxes(gaussians: Gaussians, rows: int, *, sigmas: float = 3.0) -> np.ndarray:
    """(C, 2, 3) float64 box of every ``rows`` Gaussians in a row, widened by ``sigmas`` standard deviations of each."""
    out = []
    for start in range(0, len(gaussians), rows):
        part = gaussians[start : start + rows]
        # sigma along a frame axis: sqrt of the diagonal of R diag(s^2) R^T
        variance = np.einsum("nij,nj->ni", quats_to_matrices(part.quats) ** 2, part.scales.astype(np.float64) ** 2)
        reach = sigmas * np.sqrt(variance)
        out.append(np.stack([(part.means - reach).min(0), (part.means + reach).max(0)]))
    return np.array(out).reshape(-1, 2, 3)


def _spread(cell: np.ndarray) -> np.ndarray:
    """Two zero bits after each of the low 21 bits."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        cell = (cell | (cell << np.uint64(shift))) & np.uint64(mask)
    return cell

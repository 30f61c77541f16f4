"""Boxes around chunks of Gaussians, for finding what touches a region without reading it."""

from __future__ import annotations

import numpy as np

from gsmap.geometry.rotations import quats_to_matrices
from gsmap.types import Gaussians


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

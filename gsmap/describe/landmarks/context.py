"""Landmark descriptors: colour and occupancy in rings of an upright cylinder, or in spherical shells without
gravity.
"""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

import numpy as np

from gsmap.describe.cloud import downsample

METRICS = Path(__file__).with_name("metrics.npz")
_LAB_CENTRE, _LAB_SPREAD = np.array([55.0, 3.0, 8.0]), np.array([20.0, 10.0, 14.0])


# Bins of the surroundings, in metres under the layer's unit.
CELL_M = 0.07  # the surroundings are thinned to one point per cell of this size
RADII_M = np.array([0.2, 0.45, 0.75, 1.1])  # outer radii of the cylinder's rings
HEIGHTS_M = np.array([-1.1, -0.65, -0.35, -0.12, 0.12, 0.35, 0.65, 1.1])  # limits of its levels above the landmark
SHELLS_M = np.array([0.12, 0.2, 0.3, 0.4, 0.5, 0.65, 0.8, 0.95, 1.1])  # outer radii of the shells without a vertical
NUM_RINGS = len(RADII_M) * (len(HEIGHTS_M) - 1)
NUM_SHELLS = len(SHELLS_M)
_OCCUPANCY_WEIGHT = 0.75  # of a bin's occupancy in the embedding
_COLOUR_WEIGHT = 0.7  # of a bin's colour in the embedding


def cylinder_context(positions: np.ndarray, points: np.ndarray, lab: np.ndarray) -> np.ndarray:
    """Compute contexts (M, NUM_RINGS, 4): per ring and height mean L, a, b (standardised) and occupancy.

    Rings have no direction, so that the context is invariant to rotation about gravity. A bin's
    occupancy is the number of occupied cells relative to a surface cutting through it, at most 1.

    Args:
        positions: (M, 3) levelled frame (z up), metres.
        points, lab: (N, 3) levelled cloud and its L*a*b*.
    """
    radius, height = RADII_M, HEIGHTS_M
    levels = len(height) - 1
    inner = np.concatenate([[0], radius[:-1]])
    # A vertical wall through the axis crosses a ring twice; a floor fills it. Expect the smaller of the two.
    wall = 2 * (radius - inner)[:, None] * np.diff(height)[None]
    floor = np.pi * (radius**2 - inner**2)[:, None] * np.ones(levels)[None]

    expected = np.minimum(wall, floor).ravel()
    return _context(positions, points, lab, radius, height, expected)


def shell_context(positions: np.ndarray, points: np.ndarray, lab: np.ndarray) -> np.ndarray:
    """Compute contexts (M, NUM_SHELLS, 4) in spherical shells: invariant to rotation, for scenes of unknown vertical.

    Args:
        positions: (M, 3) in any frame, metres.
        points, lab: (N, 3) the cloud in that frame and its L*a*b*.
    """
    radius = SHELLS_M
    inner = np.concatenate([[0], radius[:-1]])

    expected = np.pi * (radius**2 - inner**2)
    return _context(positions, points, lab, radius, np.zeros(0), expected)


def _context(
    positions: np.ndarray,
    points: np.ndarray,
    lab: np.ndarray,
    radii_m: np.ndarray,
    heights_m: np.ndarray,
    expected_m2: np.ndarray,
) -> np.ndarray:
    """Compute mean colour and occupancy (M, B, 4) of rings and heights, or of shells where there are no heights."""
    from gsmap import _native

    thin, colour = downsample(points, lab, CELL_M)
    values = (colour - _LAB_CENTRE) / _LAB_SPREAD
    sums, counts = _native.landmark_surroundings(
        positions=np.ascontiguousarray(positions, np.float64),
        points=np.ascontiguousarray(thin),
        values=np.ascontiguousarray(values),
        radii=radii_m,
        heights=heights_m,
    )
    out = np.zeros((*counts.shape, 4))
    out[..., :3] = sums / np.maximum(counts, 1)[..., None]
    out[..., 3] = np.minimum(1, counts * CELL_M**2 / expected_m2)
    return out


def embed(context: np.ndarray, use_fitted_metric: bool = False) -> np.ndarray:
    """Compute unit vectors (M, 4 * bins) of contexts (M, bins, 4): occupancy and relative colour.

    Exposure shifts and stretches L (gain and gamma in the logarithm of light), white balance shifts a and b, so each
    bin's colour is taken relative to the mean of the whole surrounding and divided by its spread. The mean itself is
    left out: it gains nothing under equal light, and costs most matches where white balances differ by a fifth. A bin
    is weighted by the root of its occupancy.
    """
    occupancy, colour = context[..., 3:], np.clip(context[..., :3], -2.5, 2.5)
    total = np.maximum(occupancy.sum(1), 1e-6)
    relative = colour - ((occupancy * colour).sum(1) / total)[:, None]
    spread = np.sqrt((occupancy * relative**2).sum(1) / total) + 0.15
    relative *= _COLOUR_WEIGHT * np.sqrt(occupancy) / spread[:, None]
    own = _OCCUPANCY_WEIGHT * occupancy[..., 0]
    vector = _unit(np.concatenate([own, relative.reshape(len(context), -1)], 1))
    return _unit(vector @ metric(vector.shape[1])) if use_fitted_metric else vector


@cache
def metric(dim: int) -> np.ndarray:
    """Load the metric (dim, dim) under which embeddings of one landmark in two captures differ equally in all
    directions.

    The inverse root of their scatter, with a share of the identity (`tools/fit/descriptor.py`, which writes the file):
    directions of large differences between true matches get small weights (Mikolajczyk and Matas 2007; Hua, Brown and
    Winder 2007). `metric_digest` is part of the recipe of graphs that use it: a newly fitted metric needs no new
    version.
    """
    with np.load(METRICS) as stored:
        out: np.ndarray = stored[str(dim)].astype(np.float64)
        return out


@cache
def metric_digest() -> str:
    """Return 32 hex digits (SHA-256) of the file that holds the fitted metrics."""
    return hashlib.sha256(METRICS.read_bytes()).hexdigest()[:32]


def _unit(vectors: np.ndarray) -> np.ndarray:
    out: np.ndarray = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9)
    return out

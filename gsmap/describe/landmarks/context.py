"""Landmark descriptors: colour and occupancy in rings of an upright cylinder or, without gravity, in spherical
shells."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

import numpy as np

from gsmap.describe.cloud import downsample

METRICS = Path(__file__).with_name("metrics.npz")
_LAB_CENTRE, _LAB_SPREAD = np.array([55.0, 3.0, 8.0]), np.array([20.0, 10.0, 14.0])


# Bins of the surroundings, in metres (by the unit that the layer assumes).
CELL_M = 0.07  # the surroundings are thinned to one point per cell of this size
RADII_M = np.array([0.2, 0.45, 0.75, 1.1])  # outer radii of the cylinder's rings
# Limits of the cylinder's levels, relative to the landmark.
HEIGHTS_M = np.array([-1.1, -0.65, -0.35, -0.12, 0.12, 0.35, 0.65, 1.1])
# Outer radii of the shells used without a vertical.
SHELLS_M = np.array([0.12, 0.2, 0.3, 0.4, 0.5, 0.65, 0.8, 0.95, 1.1])
NUM_RINGS = len(RADII_M) * (len(HEIGHTS_M) - 1)
NUM_SHELLS = len(SHELLS_M)
_OCCUPANCY_WEIGHT = 0.75  # of a bin's occupancy in the embedding
_COLOUR_WEIGHT = 0.7  # of a bin's colour in the embedding


def cylinder_context(positions: np.ndarray, points: np.ndarray, lab: np.ndarray, unit_m: float = 1.0) -> np.ndarray:
    """Compute contexts (M, NUM_RINGS, 4): the mean L, a, b (standardized) and the occupancy of each ring and height.

    Rings have no direction, so the context is invariant to rotation about gravity. The occupancy of a bin is its number
    of occupied cells, relative to that of a surface that cuts through the bin, at most 1.

    Args:
        positions: (M, 3) positions of the landmarks in the levelled frame (z up), metres.
        points, lab: (N, 3) points of the levelled cloud and their L*a*b*.
        unit_m: metres per unit of the points.
    """
    radius, height = RADII_M, HEIGHTS_M
    levels = len(height) - 1
    inner = np.concatenate([[0], radius[:-1]])
    # A vertical wall through the axis crosses a ring twice; a floor fills it. Expect the smaller of the two.
    wall = 2 * (radius - inner)[:, None] * np.diff(height)[None]
    floor = np.pi * (radius**2 - inner**2)[:, None] * np.ones(levels)[None]

    expected = np.minimum(wall, floor).ravel()
    return _context(positions, points, lab, unit_m, radius, height, expected)


def shell_context(positions: np.ndarray, points: np.ndarray, lab: np.ndarray, unit_m: float = 1.0) -> np.ndarray:
    """Compute contexts (M, NUM_SHELLS, 4) in spherical shells, which are invariant to rotation, for scenes of unknown
    vertical.

    Args:
        positions: (M, 3) positions of the landmarks in any frame, metres.
        points, lab: (N, 3) points of the cloud in that frame and their L*a*b*.
        unit_m: metres per unit of the points.
    """
    radius = SHELLS_M
    inner = np.concatenate([[0], radius[:-1]])

    expected = np.pi * (radius**2 - inner**2)
    return _context(positions, points, lab, unit_m, radius, np.zeros(0), expected)


def _context(
    positions: np.ndarray,
    points: np.ndarray,
    lab: np.ndarray,
    unit_m: float,
    radii_m: np.ndarray,
    heights_m: np.ndarray,
    expected_m2: np.ndarray,
) -> np.ndarray:
    """Compute mean colour and occupancy (M, B, 4) of rings and heights, or of shells if there are no heights."""
    from gsmap import _native

    thin, colour = downsample(points, lab, CELL_M / unit_m)
    values = (colour - _LAB_CENTRE) / _LAB_SPREAD
    sums, counts = _native.landmark_surroundings(
        positions=np.ascontiguousarray(positions, np.float64),
        points=np.ascontiguousarray(thin * unit_m),
        values=np.ascontiguousarray(values),
        radii=radii_m,
        heights=heights_m,
    )
    out = np.zeros((*counts.shape, 4))
    out[..., :3] = sums / np.maximum(counts, 1)[..., None]
    out[..., 3] = np.minimum(1, counts * CELL_M**2 / expected_m2)
    return out


def embed(context: np.ndarray, use_fitted_metric: bool = False) -> np.ndarray:
    """Compute unit vectors (M, 4 * bins) from contexts (M, bins, 4): occupancy and relative colour.

    Exposure shifts and stretches L (gain and gamma in the logarithm of light), and white balance shifts a and b.
    Therefore the mean of the whole surrounding is subtracted from each bin's colour, which is then divided by the
    spread. The mean itself is no feature: it gains nothing under equal light, and costs most matches where white
    balances differ by a fifth. A bin is weighted by the square root of its occupancy.
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
    """Load the metric (dim, dim) that makes the differences between embeddings of one landmark in two captures
    isotropic.

    The metric is the inverse square root of the scatter of these differences, with a share of the identity
    (`tools/fit/descriptor.py` writes the file): directions of large differences between true matches get small weights
    (Mikolajczyk and Matas 2007; Hua, Brown and Winder 2007). `metric_digest` is part of the recipe of graphs that use
    it: a newly fitted metric needs no new version.
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

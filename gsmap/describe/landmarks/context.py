"""What surrounds a landmark: colour and occupancy in the rings of an upright cylinder, or in shells without gravity."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from gsmap.describe.cloud import downsample

RADII_M = (0.2, 0.45, 0.75, 1.1)
HEIGHTS_M = (-1.1, -0.65, -0.35, -0.12, 0.12, 0.35, 0.65, 1.1)
SHELLS_M = (0.12, 0.2, 0.3, 0.4, 0.5, 0.65, 0.8, 0.95, 1.1)
NUM_RINGS, NUM_SHELLS = len(RADII_M) * (len(HEIGHTS_M) - 1), len(SHELLS_M)
_LAB_CENTRE, _LAB_SPREAD = np.array([55.0, 3.0, 8.0]), np.array([20.0, 10.0, 14.0])


def cylinder_context(positions: np.ndarray, points: np.ndarray, lab: np.ndarray, cell_m: float) -> np.ndarray:
    """Context (M, NUM_RINGS, 4) of each position: per ring and height mean L, a, b (standardised) and occupancy.

    Rings do not tell directions apart, so the context is the same however the capture is turned about gravity. A bin's
    occupancy is the number of occupied cells relative to a surface cutting through it, at most 1.

    Args:
        positions: (M, 3) levelled frame (z up), metres.
        points, lab: (N, 3) levelled cloud and its L*a*b*.
        cell_m: the cloud is thinned to one point per cell of this size first.
    """
    radius, height = np.array(RADII_M), np.array(HEIGHTS_M)
    levels = len(height) - 1
    inner = np.concatenate([[0], radius[:-1]])
    # A vertical wall through the axis crosses a ring twice; a floor fills it. Expect the smaller of the two.
    wall = 2 * (radius - inner)[:, None] * np.diff(height)[None]
    floor = np.pi * (radius**2 - inner**2)[:, None] * np.ones(levels)[None]

    def bins(offsets: np.ndarray) -> np.ndarray:
        ring = np.searchsorted(radius, np.hypot(offsets[:, 0], offsets[:, 1]))
        level = np.searchsorted(height, offsets[:, 2]) - 1
        outside = (ring == len(radius)) | (level < 0) | (level == levels)
        return np.where(outside, -1, ring * levels + level)

    reach = float(np.hypot(radius[-1], height[-1]))
    return _context(positions, points, lab, cell_m, reach, bins, np.minimum(wall, floor).ravel())


def shell_context(positions: np.ndarray, points: np.ndarray, lab: np.ndarray, cell_m: float) -> np.ndarray:
    """Context (M, NUM_SHELLS, 4) in spherical shells: the same in any frame, for scenes whose vertical is unknown."""
    radius = np.array(SHELLS_M)
    inner = np.concatenate([[0], radius[:-1]])

    def bins(offsets: np.ndarray) -> np.ndarray:
        shell = np.searchsorted(radius, np.linalg.norm(offsets, axis=1))
        return np.where(shell == len(radius), -1, shell)

    return _context(positions, points, lab, cell_m, SHELLS_M[-1], bins, np.pi * (radius**2 - inner**2))


def _context(
    positions: np.ndarray,
    points: np.ndarray,
    lab: np.ndarray,
    cell_m: float,
    reach_m: float,
    bins: Callable[[np.ndarray], np.ndarray],
    expected_m2: np.ndarray,
) -> np.ndarray:
    """Mean colour and occupancy (M, B, 4) per bin of the offsets to all points within reach; bin -1 is left out."""
    thin, colour = downsample(points, lab, cell_m)
    values = (colour - _LAB_CENTRE) / _LAB_SPREAD
    size = len(expected_m2)
    out = np.zeros((len(positions), size, 4))
    for row, near in enumerate(cKDTree(thin).query_ball_point(positions, reach_m, return_sorted=False)):
        near = np.asarray(near, dtype=np.int64)
        at = bins(thin[near] - positions[row])
        near, at = near[at >= 0], at[at >= 0]
        count = np.bincount(at, minlength=size)
        for c in range(3):
            out[row, :, c] = np.bincount(at, values[near, c], size) / np.maximum(count, 1)
        out[row, :, 3] = np.minimum(1, count * cell_m**2 / expected_m2)
    return out

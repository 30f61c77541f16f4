"""What surrounds a landmark: colour and occupancy in the rings of an upright cylinder."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from gsmap.describe.cloud import downsample

RADII_M = (0.2, 0.45, 0.75, 1.1)
HEIGHTS_M = (-1.1, -0.65, -0.35, -0.12, 0.12, 0.35, 0.65, 1.1)
NUM_BINS = len(RADII_M) * (len(HEIGHTS_M) - 1)
_LAB_CENTRE, _LAB_SPREAD = np.array([55.0, 3.0, 8.0]), np.array([20.0, 10.0, 14.0])


def cylinder_context(positions: np.ndarray, points: np.ndarray, lab: np.ndarray, cell_m: float) -> np.ndarray:
    """Context (M, 28, 4) of each position: per ring and height, square-root-weighted L, a, b and occupancy.

    Rings do not tell directions apart, so the context is the same however the capture is turned about gravity. A bin's
    occupancy is the number of occupied cells relative to a surface cutting through it, at most 1.

    Args:
        positions: (M, 3) levelled frame, metres.
        points, lab: (N, 3) levelled cloud and its L*a*b*.
        cell_m: the cloud is thinned to one point per cell of this size first.
    """
    thin, colour = downsample(points, lab, cell_m)
    values = (colour - _LAB_CENTRE) / _LAB_SPREAD
    radius, height = np.array(RADII_M), np.array(HEIGHTS_M)
    inner = np.concatenate([[0], radius[:-1]])
    # A vertical wall through the axis crosses a ring twice; a floor fills it. Expect the smaller of the two.
    wall = 2 * (radius - inner)[:, None] * np.diff(height)[None]
    floor = np.pi * (radius**2 - inner**2)[:, None] * np.ones(len(height) - 1)[None]
    expected = (np.minimum(wall, floor) / cell_m**2).ravel()
    reach = float(np.hypot(radius[-1], height[-1]))
    out = np.zeros((len(positions), NUM_BINS, 4))
    tree = cKDTree(thin)
    for row, near in enumerate(tree.query_ball_point(positions, reach, return_sorted=False)):
        near = np.asarray(near, dtype=np.int64)
        d = thin[near] - positions[row]
        ring = np.searchsorted(radius, np.hypot(d[:, 0], d[:, 1]))
        level = np.searchsorted(height, d[:, 2]) - 1
        inside = (ring < len(radius)) & (level >= 0) & (level < len(height) - 1)
        bins = ring[inside] * (len(height) - 1) + level[inside]
        count = np.bincount(bins, minlength=NUM_BINS)
        for c in range(3):
            total = np.bincount(bins, values[near[inside], c], NUM_BINS)
            out[row, :, c] = total / np.maximum(count, 1)
        out[row, :, 3] = np.minimum(1, count / expected)
    return out

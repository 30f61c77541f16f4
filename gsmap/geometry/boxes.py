"""Axis-aligned boxes, (2, 3): lowest and highest corner."""

from __future__ import annotations

import numpy as np


def box_corners(bounds: np.ndarray) -> np.ndarray:
    """(8, 3) corners of a box; bit 0 of a corner's index tells whether its x is the high one, bit 1 y, bit 2 z."""
    return np.array([[bounds[i >> axis & 1][axis] for axis in range(3)] for i in range(8)], dtype=np.float64)

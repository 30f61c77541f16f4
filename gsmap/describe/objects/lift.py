"""Lift masks to the Gaussians that they show."""

from __future__ import annotations

import numpy as np

from gsmap.geometry.projection import on_surface
from gsmap.types.views import View


def find_visible(points: np.ndarray, view: View, tolerance: float = 0.03) -> tuple[np.ndarray, np.ndarray]:
    """Find the visible points on the surface of a view: return their rows, and their pixels (n, 2) int64
    ``column row``.

    A point is on the surface if its depth agrees with the rendered depth at its pixel, to within ``tolerance`` times
    that depth. Graph-GSReg only requires that a centre projects into the mask, which includes points behind the object;
    a tolerance of inf does the same.

    Args:
        points: (N, 3) points in the frame and unit of the render.
    """
    return on_surface(points, view.camera.T_camera_frame[0], view.camera.intrinsics_px[0], view.depth, tolerance)

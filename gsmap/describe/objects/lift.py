"""From a mask in a view to the Gaussians it shows."""

from __future__ import annotations

import numpy as np

from gsmap.geometry.projection import on_surface
from gsmap.types.views import View


def visible(points: np.ndarray, view: View, tolerance: float = 0.03) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the points that lie on the surface the view sees, and their pixels (n, 2) int64 ``column row``.

    A point is on it when its depth agrees with the rendered depth at its pixel to within ``tolerance`` of that depth:
    the paper asks only that a centre projects into the mask, which also takes what lies behind the object, as a
    tolerance of inf does.

    Args:
        points: (N, 3) in the frame and unit that was rendered.
    """
    return on_surface(points, view.camera.T_camera_frame[0], view.camera.intrinsics_px[0], view.depth, tolerance)

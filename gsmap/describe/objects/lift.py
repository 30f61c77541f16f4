"""From a mask in a view to the Gaussians it shows."""

from __future__ import annotations

import numpy as np

from gsmap.describe.views import View


def project(points: np.ndarray, view: View) -> tuple[np.ndarray, np.ndarray]:
    """Pixel (N, 2) int ``column row`` of each point and its depth (N,); the pixel is -1 where it falls outside."""
    T, (fx, fy, cx, cy) = view.camera.T_camera_frame[0], view.camera.intrinsics_px[0]
    local = points @ T[:3, :3].T + T[:3, 3]
    z = local[:, 2]
    ahead = z > 1e-9
    safe = np.where(ahead, z, 1.0)
    height, width = view.depth.shape
    u, v = fx * local[:, 0] / safe + cx, fy * local[:, 1] / safe + cy
    inside = ahead & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    pixel = np.full((len(points), 2), -1, dtype=np.int64)
    pixel[inside] = np.stack([u[inside], v[inside]], 1).astype(np.int64)
    return pixel, z


def visible(points: np.ndarray, view: View, tolerance: float = 0.03) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the points that lie on the surface the view sees, and their pixels (n, 2) ``column row``.

    A point is on it when its depth agrees with the rendered depth at its pixel to within ``tolerance`` of that depth:
    the paper asks only that a centre projects into the mask, which also takes what lies behind the object.
    """
    pixel, z = project(points, view)
    rows = np.flatnonzero(pixel[:, 0] >= 0)
    depth = view.depth[pixel[rows, 1], pixel[rows, 0]]
    on = (depth > 0) & (np.abs(z[rows] - depth) < tolerance * depth)
    return rows[on], pixel[rows[on]]

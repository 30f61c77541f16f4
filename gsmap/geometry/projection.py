"""Project points to pixels with a pinhole camera."""

from __future__ import annotations

import numpy as np

from gsmap._native import points_on_surface


def project(points: np.ndarray, T_camera_frame: np.ndarray, intrinsics_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project points to an image.

    Args:
        points: (N, 3) points of any floating type; the result has the same type.
        T_camera_frame: (4, 4) transform from frame to camera (OpenCV axes: x right, y down, z forward).
        intrinsics_px: (4,) ``fx fy cx cy``.

    Returns:
        The (N, 2) pixel coordinates ``column row`` (the centre of the first pixel is 0.5 0.5), undefined if the depth
        is not positive; and the (N,) depths along the camera's axis.
    """
    column, row, z = project_all(points, T_camera_frame, intrinsics_px)
    return np.stack([column, row], axis=1), z


def project_all(
    points: np.ndarray, T_camera_frame: np.ndarray, intrinsics_px: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the columns, rows and depths (..., N) of points (N, 3), as `project` does, in one image or in many at
    once.

    Args:
        T_camera_frame: (..., 4, 4) transforms from frame to camera.
        intrinsics_px: (..., 4) ``fx fy cx cy``.
    """
    view = np.asarray(T_camera_frame).astype(points.dtype, copy=False)
    fx, fy, cx, cy = np.moveaxis(np.asarray(intrinsics_px).astype(points.dtype)[..., None], -2, 0)
    local = points @ view[..., :3, :3].swapaxes(-1, -2) + view[..., None, :3, 3]
    z = local[..., 2]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return fx * local[..., 0] / z + cx, fy * local[..., 1] / z + cy, z


def in_image(pixels: np.ndarray, depth: np.ndarray, size_px: np.ndarray, near: float = 0.0) -> np.ndarray:
    """Return an (N,) mask of points that are farther than ``near`` and inside an image of ``size_px`` =
    ``width height``."""
    (column, row), (width, height) = pixels.T, np.asarray(size_px)
    with np.errstate(invalid="ignore"):
        inside: np.ndarray = (depth > near) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return inside


def on_surface(
    points: np.ndarray, T_camera_frame: np.ndarray, intrinsics_px: np.ndarray, depth: np.ndarray, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Select the points that lie on the surface of a depth image.

    Args:
        points, T_camera_frame, intrinsics_px: as in `project`.
        depth: (H, W) camera-space z in the unit of the points, 0 without a surface.
        tolerance: largest difference of depths, as a share of the surface's depth; inf selects points behind and in
            front of the surface as well.

    Returns:
        The (n,) rows of the selected points, and their pixels (n, 2) int64 ``column row``.
    """
    points = np.ascontiguousarray(points, np.float64)
    view = np.ascontiguousarray(T_camera_frame, np.float64)
    intrinsics = np.ascontiguousarray(intrinsics_px, np.float64)
    found: tuple[np.ndarray, np.ndarray] = points_on_surface(
        points, view, intrinsics, np.ascontiguousarray(depth, np.float32), tolerance
    )
    return found

"""Extract the surface of a scene as a coloured point cloud, from its Gaussians without rendering."""

from __future__ import annotations

import numpy as np

from gsmap._native import local_planes as native_planes
from gsmap.geometry.boxes import are_finite
from gsmap.geometry.cells import cell_means
from gsmap.geometry.colour import srgb_to_lab
from gsmap.geometry.floaters import find_floaters
from gsmap.geometry.neighbours import nearest_neighbours
from gsmap.geometry.sh import rgb_of_sh0
from gsmap.types import Gaussians
from gsmap.types.views import PointCloud

_MAX_RELATIVE_SCALE = 3.5  # a Gaussian whose largest scale exceeds this many times the median is no surface
_FLOATER_LAB = 20.0  # a Gaussian whose colour differs more from its neighbours (L*a*b*) is a floater


def surface_cloud(gaussians: Gaussians, min_opacity: float = 0.1) -> PointCloud:
    """Return the centres of surface Gaussians: opaque, not huge, and no floaters.

    All criteria are relative to the capture, so the cloud does not depend on the scene's unit: a Gaussian is dropped if
    its largest scale exceeds a multiple of the median, or if it is a floater (`find_floaters`). Colours are
    view-independent (SH degree 0).

    Args:
        gaussians: Gaussians in any frame and unit; those with NaN or infinity are left out.
        min_opacity: Gaussians of lower opacity are left out.

    Returns:
        Points in the frame and unit of the Gaussians.
    """
    x, y, z = gaussians.scales.T
    scale = np.maximum(np.maximum(x, y), z)
    finite = are_finite(gaussians.means) & np.isfinite(scale) & are_finite(gaussians.sh[:, 0])
    keep = np.flatnonzero((gaussians.opacities > min_opacity) & finite)
    if len(keep):
        keep = keep[scale[keep] <= _MAX_RELATIVE_SCALE * np.median(scale[keep])]
    points = gaussians.means.take(keep, axis=0).astype(np.float64)
    lab = srgb_to_lab(np.clip(rgb_of_sh0(gaussians.sh[:, 0].take(keep, axis=0)), 0.0, 1.0))
    stray, spacing = find_floaters(points, lab, _FLOATER_LAB)
    rows = np.flatnonzero(~stray)
    return PointCloud(points.take(rows, axis=0), lab.take(rows, axis=0), np.pi / 8 * spacing[rows] ** 2, keep[rows])


def downsample(points: np.ndarray, values: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean position and mean value of the points of each occupied grid cell; ``values`` is (N, 3)."""
    low = np.array([column.min() for column in points.T]) if len(points) else None
    return cell_means(points, values, cell, origin=low)[:2]


def local_planes(points: np.ndarray, num_neighbours: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """Compute the normals (N, 3; sign arbitrary) and planarity (N,) in [0, 1] of points from the principal axes of
    their neighbourhoods."""
    k = min(num_neighbours, len(points))
    if k < 4:
        return np.zeros((len(points), 3)), np.zeros(len(points))
    normals, planarity = native_planes(points, nearest_neighbours(points, k)[1])
    return normals, np.clip(planarity, 0, 1)

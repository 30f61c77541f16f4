"""The surface of a scene as a coloured point cloud, taken from its Gaussians without rendering."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from gsmap.describe.colour import srgb_to_lab
from gsmap.geometry.floaters import find_floaters
from gsmap.types import Gaussians

_SH_C0 = 0.28209479177387814
_STRAY_LAB = 20.0  # colours farther apart are unlike


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points of a surface.

    Args:
        points: (N, 3) float64.
        lab: (N, 3) float32 CIE L*a*b* (D65).
        areas: (N,) the surface each point stands for: a disc that holds its 8 nearest neighbours, divided among them.
        index: (N,) rows of the Gaussians the points are the centres of.
    """

    points: np.ndarray
    lab: np.ndarray
    areas: np.ndarray
    index: np.ndarray

    def __len__(self) -> int:
        return len(self.points)


def surface_cloud(gaussians: Gaussians, *, min_opacity: float = 0.1) -> Cloud:
    """Centres of the Gaussians that make up the surface: opaque, not huge, not floating alone, not of a foreign colour.

    "Huge" and "alone" are told from the capture itself, so that the cloud of a scene does not depend on its unit: a
    Gaussian is dropped when its largest scale exceeds 3.5 times the median one, or it floats (`find_floaters`).
    Colour is the view-independent part (SH degree 0).
    """
    scale = gaussians.scales.max(1, initial=0)
    finite = np.isfinite(gaussians.means).all(1) & np.isfinite(scale) & np.isfinite(gaussians.sh[:, 0]).all(1)
    keep = np.flatnonzero((gaussians.opacities > min_opacity) & finite)
    if len(keep):
        keep = keep[scale[keep] <= 3.5 * np.median(scale[keep])]
    points = gaussians.means[keep].astype(np.float64)
    lab = srgb_to_lab(np.clip(_SH_C0 * gaussians.sh[keep, 0] + 0.5, 0.0, 1.0))
    stray, spacing = find_floaters(points, lab, _STRAY_LAB)
    return Cloud(points[~stray], lab[~stray], np.pi / 8 * spacing[~stray] ** 2, keep[~stray])


def downsample(points: np.ndarray, values: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean position and mean value of the points of each occupied cell of a grid; ``values`` is (N, F)."""
    keys = np.floor((points - points.min(0)) / cell).astype(np.int64) if len(points) else np.zeros((0, 3), np.int64)
    size = keys.max(0) + 1 if len(points) else np.ones(3, np.int64)
    flat = (keys[:, 0] * size[1] + keys[:, 1]) * size[2] + keys[:, 2]
    _, inverse, count = np.unique(flat, return_inverse=True, return_counts=True)
    both = np.concatenate([points, values], axis=1)
    mean = np.stack([np.bincount(inverse, both[:, i], len(count)) for i in range(both.shape[1])], 1) / count[:, None]
    return mean[:, :3], mean[:, 3:]


def local_planes(points: np.ndarray, num_neighbours: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """Normal (N, 3; sign arbitrary) and planarity (N,) in [0, 1] of each point's neighbourhood (principal axes)."""
    k = min(num_neighbours, len(points))
    if k < 4:
        return np.zeros((len(points), 3)), np.zeros(len(points))
    neighbours = points[cKDTree(points).query(points, k=k)[1]]
    centred = neighbours - neighbours.mean(1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))
    planarity = (values[:, 1] - values[:, 0]) / np.maximum(values[:, 2], 1e-12)
    return vectors[:, :, 0], np.clip(planarity, 0, 1)

"""Which Gaussians of overlapping captures to keep: one capture per place, and of it what shows."""

from __future__ import annotations

import numpy as np

from gsmap.types import Gaussians


def one_owner_per_cell(
    gaussians: Gaussians, origin: np.ndarray, visible_pixels: np.ndarray, cell_m: float, cover_m: float
) -> np.ndarray:
    """(N,) which Gaussians stay when every cell of a grid belongs to the capture that shows most of it.

    Two captures of one surface laid over one another blur it and stop its light twice: the ghosts of a plain union.
    A Gaussian of another capture than its cell's owner stays only where the owner has nothing near: a place the owner
    did not see.

    Args:
        origin: (N,) capture each Gaussian came from.
        visible_pixels: (N,) pixels that each Gaussian dominates in its own capture's views.
        cell_m: side of a cell.
        cover_m: an owner's Gaussian this near covers another's.
    """
    from scipy.spatial import cKDTree

    from gsmap.geometry.voxels import voxel_labels

    captures = int(origin.max(initial=-1)) + 1
    if captures < 2:
        return np.ones(len(gaussians), dtype=bool)
    cell = voxel_labels(gaussians.means, cell_m)
    count = int(cell.max()) + 1
    votes = np.stack([np.bincount(cell, visible_pixels * (origin == c), count) for c in range(captures)])
    owner = votes.argmax(0)[cell]
    stays = owner == origin
    for c in range(captures):
        own = stays & (origin == c)
        others = np.flatnonzero(~stays & (owner == c) & (visible_pixels > 0))
        if len(others) == 0 or not own.any():
            continue
        tree = cKDTree(gaussians.means[own])
        distance, _ = tree.query(gaussians.means[others], distance_upper_bound=cover_m)
        stays[others[np.isinf(distance)]] = True
    return stays


def beside(means: np.ndarray, origin: np.ndarray, chosen: np.ndarray, distance_m: float) -> np.ndarray:
    """(N,) which of the Gaussians that are not chosen lie within a distance of one of another capture that is."""
    from scipy.spatial import cKDTree

    near = np.zeros(len(means), dtype=bool)
    for capture in np.unique(origin[chosen]):
        tree = cKDTree(means[chosen & (origin == capture)])
        others = np.flatnonzero(~chosen & (origin != capture))
        near[others[np.isfinite(tree.query(means[others], distance_upper_bound=distance_m)[0])]] = True
    return near

"""Select Gaussians of overlapping scenes: each cell belongs to one owner scene."""

from __future__ import annotations

import numpy as np

from gsmap.types import Gaussians


def select_owners(
    gaussians: Gaussians, origin: np.ndarray, visible_pixels: np.ndarray, cell_m: float, cover_m: float
) -> np.ndarray:
    """Return an (N,) mask of Gaussians that remain if every grid cell belongs to the scene that shows most of it.

    If two scenes of one surface are overlaid, they blur the surface and absorb light twice, as in a plain union. A
    Gaussian of a scene that does not own its cell stays only if the owner has no Gaussian nearby, that is, did not
    observe the place.

    Args:
        gaussians: N Gaussians of all scenes.
        origin: (N,) scene of each Gaussian.
        visible_pixels: (N,) number of pixels that each Gaussian dominates in the views of its own scene.
        cell_m: edge of a cell.
        cover_m: a Gaussian of the owner replaces Gaussians of other scenes within this distance.
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


def near_other_scene(means: np.ndarray, origin: np.ndarray, chosen: np.ndarray, distance_m: float) -> np.ndarray:
    """Return an (N,) mask of Gaussians that are not chosen but lie within a distance of a chosen Gaussian of another
    scene."""
    from scipy.spatial import cKDTree

    near = np.zeros(len(means), dtype=bool)
    for capture in np.unique(origin[chosen]):
        tree = cKDTree(means[chosen & (origin == capture)])
        others = np.flatnonzero(~chosen & (origin != capture))
        near[others[np.isfinite(tree.query(means[others], distance_upper_bound=distance_m)[0])]] = True
    return near

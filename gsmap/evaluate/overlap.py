"""Compute the true overlap of captures from their true poses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from gsmap.types import Gaussians, Sim3

_CACHED_TREES = 32


RADIUS_M = 0.08  # a Gaussian coincides with a capture that has a Gaussian within this distance
_MIN_OPACITY = 0.3  # smallest opacity of surface Gaussians ...
_MAX_SCALE_M = 0.3  # ... and their largest standard deviation


def solid_centres(gaussians: Gaussians, S_scene_world: Sim3) -> np.ndarray:
    """Return the (N, 3) centres of surface Gaussians (opaque, not huge) in the true world frame, in metres."""
    size_m = gaussians.scales.max(1, initial=0) / S_scene_world.scale
    keep = (gaussians.opacities > _MIN_OPACITY) & (size_m < _MAX_SCALE_M)
    return S_scene_world.inverse().apply(gaussians.means[keep])


def true_overlaps(
    scenes: Sequence[str], centres: Callable[[str], np.ndarray], radius_m: float = RADIUS_M
) -> dict[frozenset[str], float]:
    """Return the true overlap of each pair of scenes: the share of centres that coincide with the other capture; the
    smaller of both directions.

    Only pairs whose boxes intersect are computed.

    Args:
        scenes: ids of the scenes.
        centres: function that returns the `solid_centres` of one scene.
        radius_m: largest distance between Gaussians that coincide.
    """
    from scipy.spatial import cKDTree

    @lru_cache(_CACHED_TREES)
    def tree_of(scene: str) -> Any:
        return cKDTree(centres(scene))

    boxes = np.full((len(scenes), 2, 3), np.nan)  # scenes without a surface overlap with no scene
    for row, scene in enumerate(scenes):
        points = tree_of(scene).data
        if len(points):
            boxes[row] = points.min(0), points.max(0)
    out = {}
    for i, a in enumerate(scenes):
        meets = ((boxes[:, 0] <= boxes[i, 1] + radius_m) & (boxes[:, 1] >= boxes[i, 0] - radius_m)).all(1)
        for j in range(i + 1, len(scenes)):
            overlap = 0.0
            if meets[j]:
                one, other = tree_of(a), tree_of(scenes[j])
                overlap = min(_share(one, other, radius_m), _share(other, one, radius_m))
            out[frozenset((a, scenes[j]))] = overlap
    return out


def _share(tree: Any, other: Any, radius_m: float) -> float:
    """Return the share of one capture's points that are within the radius of a point of the other capture."""
    points, low, high = tree.data, other.mins - radius_m, other.maxes + radius_m
    inside = points[((points >= low) & (points <= high)).all(1)]
    distance, _ = other.query(inside, distance_upper_bound=radius_m)
    return float(np.isfinite(distance).sum()) / len(points)

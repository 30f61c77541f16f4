"""Reduce the number of Gaussians by merging those pairs whose merging changes renders least.

Each pair of neighbours has a cost: the energy of the difference between the light of both Gaussians and the light of
the single Gaussian with the same moments (`gsmap.geometry.voxels.merge_groups`), all slightly blurred. The light of a
Gaussian is its opacity times the square root of its projected area; the common share of the light of two Gaussians is
their Bhattacharyya coefficient. So each Gaussian is merged with the neighbour that is most similar in position, shape
and colour, without a grid. With observed pixel counts, Gaussians that cameras see more often or from nearer have higher
costs. Every round merges all pairs that are mutually cheapest. Merging only the globally cheapest pairs gives worse
renders, because a few places grow coarse.
"""

from __future__ import annotations

import numpy as np

from gsmap._native import merged_pairs
from gsmap.errors import ConfigError
from gsmap.geometry.voxels import merge_groups, projected_areas
from gsmap.types import Gaussians

_NEIGHBOURS = 12
_BLUR = 0.05  # of the median of the largest standard deviations; finer details are ignored
_COVER = 0.1  # weight of occlusion relative to emitted light, because black Gaussians are visible as well
_AVERAGED = 16  # number of neighbours over which pixel counts are averaged
_MAX_FACTOR = 10.0  # largest factor, up or down, of a Gaussian's cost relative to the median
_PASSES = 5  # passes over the pairs of a round; each merges the mutually cheapest pairs


def decimate(gaussians: Gaussians, max_count: int, pixels: np.ndarray | None = None) -> tuple[Gaussians, np.ndarray]:
    """Merge Gaussians into at most ``max_count``; return the result and, for each input, the (N,) int64 row into which
    it was merged.

    Args:
        pixels: (N,) number of pixels in which cameras see each Gaussian; by default proportional to its area.

    Raises:
        ConfigError: ``max_count`` is less than 1.
    """
    if max_count < 1:
        raise ConfigError(f"the number of Gaussians to keep must be at least 1, got {max_count}", code="out_of_range")
    if len(gaussians) <= max_count:
        return gaussians, np.arange(len(gaussians))
    base = np.ascontiguousarray(gaussians.sh[:, 0])
    g, weights = gaussians, None if pixels is None else _pixel_weights(gaussians, pixels)
    arrays = g.means, g.quats, g.log_scales, g.logit_opacities, base, weights
    label = merged_pairs(*arrays, max_count, _NEIGHBOURS, _PASSES, _BLUR, _COVER)
    return merge_groups(gaussians, label)[0], label


def _pixel_weights(gaussians: Gaussians, pixels: np.ndarray) -> np.ndarray:
    """Return the (N,) number of pixels per area around each Gaussian, as a multiple of the median."""
    from scipy.spatial import cKDTree  # imported here, as the recipe key does not need it

    near = cKDTree(gaussians.means).query(gaussians.means, np.arange(1, min(_AVERAGED, len(gaussians)) + 1))[1]
    density = pixels[near].sum(1) / projected_areas(gaussians.scales)[near].sum(1)
    known = density > 0
    if not known.any():
        return np.ones(len(gaussians))
    out: np.ndarray = np.clip(density / np.median(density[known]), 1 / _MAX_FACTOR, _MAX_FACTOR)
    return out

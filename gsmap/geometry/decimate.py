"""Reduce the number of Gaussians by merging the pairs whose merging changes renders least.

Each pair of neighbours has a cost: the energy of the difference between the light that the two give and that of the one
Gaussian which keeps their moments (`gsmap.geometry.voxels.merge_groups`), all blurred a little. A Gaussian's light is
its opacity times the root of its projected area; of two, the share that they have in common is Bhattacharyya's
coefficient. So each Gaussian is merged with the most similar neighbour in place, shape and colour, without a grid. With
observed pixel counts, Gaussians that cameras see more often or from nearer cost more. Every round merges all pairs that
are mutually cheapest: merging only the cheapest pairs of all gives worse renders, as few places grow coarse.
"""

from __future__ import annotations

import numpy as np

from gsmap._native import merged_pairs
from gsmap.errors import ConfigError
from gsmap.geometry.voxels import merge_groups, projected_areas
from gsmap.types import Gaussians

_NEIGHBOURS = 12
_BLUR = 0.05  # of the median Gaussian's largest deviation; thinner details are ignored
_COVER = 0.1  # weight of occlusion relative to emitted light: black Gaussians are visible, too
_AVERAGED = 16  # neighbours over which pixel counts are averaged
_MAX_FACTOR = 10.0  # of a Gaussian's cost, relative to the median, up or down
_PASSES = 5  # over the pairs of a round, each merging the mutually cheapest ones


def decimate(gaussians: Gaussians, max_count: int, pixels: np.ndarray | None = None) -> tuple[Gaussians, np.ndarray]:
    """Merge Gaussians into at most ``max_count``; return these and the (N,) int64 row that each input was merged into.

    Args:
        pixels: (N,) number of pixels in which cameras see each Gaussian; uniform by area by default.

    Raises:
        ConfigError: ``max_count`` is less than 1.
    """
    if max_count < 1:
        raise ConfigError(f"at least one Gaussian must be left, {max_count} asked for", code="out_of_range")
    if len(gaussians) <= max_count:
        return gaussians, np.arange(len(gaussians))
    base = np.ascontiguousarray(gaussians.sh[:, 0])
    g, weights = gaussians, None if pixels is None else _pixel_weights(gaussians, pixels)
    arrays = g.means, g.quats, g.log_scales, g.logit_opacities, base, weights
    label = merged_pairs(*arrays, max_count, _NEIGHBOURS, _PASSES, _BLUR, _COVER)
    return merge_groups(gaussians, label)[0], label


def _pixel_weights(gaussians: Gaussians, pixels: np.ndarray) -> np.ndarray:
    """Return the (N,) pixels per area around each Gaussian, as a multiple of the median."""
    from scipy.spatial import cKDTree  # naming a recipe does without

    near = cKDTree(gaussians.means).query(gaussians.means, np.arange(1, min(_AVERAGED, len(gaussians)) + 1))[1]
    density = pixels[near].sum(1) / projected_areas(gaussians.scales)[near].sum(1)
    known = density > 0
    if not known.any():
        return np.ones(len(gaussians))
    out: np.ndarray = np.clip(density / np.median(density[known]), 1 / _MAX_FACTOR, _MAX_FACTOR)
    return out

"""Fewer Gaussians that look alike: the two whose replacement by one is seen least become one, again and again.

Each pair of neighbours has a cost: the energy of the difference between the light that the two give and that of the one
Gaussian which keeps their moments (`gsmap.geometry.voxels.merge_groups`), all blurred a little. A Gaussian's light is
its opacity times the root of its projected area; of two, the share that they have in common is Bhattacharyya's
coefficient. So each is merged with the neighbour that it is most like, in place, shape and colour, and no grid cuts
through. What is looked at more often, or from nearer, than its area alone tells costs more, where somebody knows. Every
round merges as many pairs as there are that are cheapest for both: taking only the cheapest of all was
tried, and draws worse pictures, as the same few places grow coarse.
"""

from __future__ import annotations

import numpy as np

from gsmap._native import merged_pairs
from gsmap.errors import ConfigError
from gsmap.geometry.voxels import merge_groups, projected_areas
from gsmap.types import Gaussians

_NEIGHBOURS = 12
_BLUR = 0.05  # of the median Gaussian's largest deviation: what is thinner is not told apart
_COVER = 0.1  # how much hiding what is behind counts beside the light of a colour: black is seen, too
_ABOUT = 16  # Gaussians over which the pixels that each shows in are averaged
_MOST = 10.0  # times more, or less, than the median that a Gaussian's cost may count
_PASSES = 5  # over the pairs of a round, each taking those that are cheapest for both


def decimate(gaussians: Gaussians, max_count: int, pixels: np.ndarray | None = None) -> tuple[Gaussians, np.ndarray]:
    """At most ``max_count`` Gaussians, and (N,) int64 which of them each of the given ones went into.

    Args:
        pixels: (N,) in how many pixels of the pictures that matter each Gaussian shows; without, all are looked at
            alike.

    Raises:
        ConfigError: less than one is asked for.
    """
    if max_count < 1:
        raise ConfigError(f"at least one Gaussian must be left, {max_count} asked for", code="out_of_range")
    if len(gaussians) <= max_count:
        return gaussians, np.arange(len(gaussians))
    base = np.ascontiguousarray(gaussians.sh[:, 0])
    g, weights = gaussians, None if pixels is None else _looked_at(gaussians, pixels)
    arrays = g.means, g.quats, g.log_scales, g.logit_opacities, base, weights
    label = merged_pairs(*arrays, max_count, _NEIGHBOURS, _PASSES, _BLUR, _COVER)
    return merge_groups(gaussians, label)[0], label


def _looked_at(gaussians: Gaussians, pixels: np.ndarray) -> np.ndarray:
    """(N,) pixels in which Gaussians show for their area, about each, as a multiple of the median."""
    from scipy.spatial import cKDTree  # naming a recipe does without

    near = cKDTree(gaussians.means).query(gaussians.means, np.arange(1, min(_ABOUT, len(gaussians)) + 1))[1]
    density = pixels[near].sum(1) / projected_areas(gaussians.scales)[near].sum(1)
    known = density > 0
    if not known.any():
        return np.ones(len(gaussians))
    out: np.ndarray = np.clip(density / np.median(density[known]), 1 / _MOST, _MOST)
    return out

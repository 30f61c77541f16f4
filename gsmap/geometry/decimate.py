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
from scipy.spatial import cKDTree

from gsmap._native import pair_costs
from gsmap.errors import ConfigError
from gsmap.geometry.morton import morton_order
from gsmap.geometry.sh import rgb_of_sh0
from gsmap.geometry.voxels import covariances, merge_groups, optical_depths, projected_areas
from gsmap.types import Gaussians

_NEIGHBOURS = 12
_BLUR = 0.05  # of the median Gaussian's largest deviation: what is thinner is not told apart
_COVER = 0.1  # how much hiding what is behind counts beside the light of a colour: black is seen, too
_BLOCK = 1 << 14  # points whose neighbours are compared at once
_ABOUT = 16  # Gaussians over which the pixels that each shows in are averaged
_MOST = 10.0  # times more, or less, than the median that a Gaussian's cost may count
_PASSES = 6  # over the pairs of a round, each taking those that are cheapest for both


def decimate(gaussians: Gaussians, max_count: int, pixels: np.ndarray | None = None) -> tuple[Gaussians, np.ndarray]:
    """At most ``max_count`` Gaussians, and (N,) int64 which of them each of the given ones went into.

    Args:
        pixels: (N,) in how many pixels of the pictures that matter each Gaussian shows; without, all are looked at
            alike.

    Raises:
        ConfigError: less than one is asked for.
    """
    if max_count < 1:
        raise ConfigError(f"at least one Gaussian must be left, {max_count} asked for")
    label = np.arange(len(gaussians))
    if len(gaussians) <= max_count:
        return gaussians, label
    weights = np.ones(len(gaussians)) if pixels is None else _looked_at(gaussians, pixels)
    while len(gaussians) > max_count:
        first, second = _cheapest(gaussians, weights, len(gaussians) - max_count)
        into = np.arange(len(gaussians))
        into[second] = first
        into = np.unique(into, return_inverse=True)[1]
        gaussians, _ = merge_groups(gaussians, into)
        heavier = np.zeros(len(gaussians))
        np.maximum.at(heavier, into, weights)
        label, weights = into[label], heavier
    return gaussians, label


def _looked_at(gaussians: Gaussians, pixels: np.ndarray) -> np.ndarray:
    """(N,) pixels in which Gaussians show for their area, about each, as a multiple of the median."""
    near = cKDTree(gaussians.means).query(gaussians.means, np.arange(1, min(_ABOUT, len(gaussians)) + 1))[1]
    density = pixels[near].sum(1) / projected_areas(gaussians.scales)[near].sum(1)
    known = density > 0
    if not known.any():
        return np.ones(len(gaussians))
    out: np.ndarray = np.clip(density / np.median(density[known]), 1 / _MOST, _MOST)
    return out


def _cheapest(gaussians: Gaussians, weights: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows of pairs that have no Gaussian in common, the cheapest, at most so many and at least one."""
    n = len(gaussians)
    pairs = _neighbours(gaussians.means)
    S = covariances(gaussians)
    deviation = float(np.median(np.exp(gaussians.log_scales.max(1).astype(np.float64))))
    costs = pair_costs(
        gaussians.means.astype(np.float64),
        np.ascontiguousarray(S[:, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)]),
        optical_depths(gaussians) * projected_areas(gaussians.scales) + 1e-30,
        gaussians.opacities.astype(np.float64),
        rgb_of_sh0(gaussians.sh[:, 0]).astype(np.float64),
        pairs,
        _BLUR * deviation,
        _COVER,
    )
    costs = costs * weights[pairs].mean(1)
    # Of equal costs the earlier pair goes first, whatever sorts them.
    order = np.argsort(costs, kind="stable")
    first, second = pairs[order].T
    rank = np.arange(len(order))
    taken = np.zeros(n, dtype=bool)
    chosen = []
    for _ in range(_PASSES):
        best = np.full(n, len(order))
        np.minimum.at(best, first, rank)
        np.minimum.at(best, second, rank)
        mutual = (best[first] == rank) & (best[second] == rank)
        chosen.append(rank[mutual])
        taken[first[mutual]] = taken[second[mutual]] = True
        left = ~(taken[first] | taken[second])
        first, second, rank = first[left], second[left], rank[left]
        if not len(rank):
            break
    some = order[np.sort(np.concatenate(chosen))[:most]]
    return pairs[some, 0], pairs[some, 1]


def _neighbours(points: np.ndarray) -> np.ndarray:
    """(E, 2) int32 pairs of points, one among the other's nearest, the lower row first; each once."""
    count = min(_NEIGHBOURS, len(points) - 1)
    # Along a curve through them, as their neighbours are then in the cache.
    order = morton_order(points)
    found = cKDTree(points[order]).query(points[order], k=count + 1)[1]
    near = np.empty((len(points), count + 1), np.int32)
    near[order] = order[found]
    kept = []
    for start in range(0, len(points), _BLOCK):
        rows = np.arange(start, min(start + _BLOCK, len(points)), dtype=np.int32)[:, None]
        others = near[rows[:, 0]]
        # Among points that coincide a point need not be the first of its own neighbours.
        told_there = (others < rows) & (near[others] == rows[:, :, None]).any(2)
        new = (others != rows) & ~told_there
        rows = np.broadcast_to(rows, others.shape)[new]
        kept.append(np.stack([np.minimum(rows, others[new]), np.maximum(rows, others[new])], axis=1))
    return np.concatenate(kept)

"""Compute the density of edges between two parts of a map, which separates adjacent places from similar places."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import betaln

from gsmap.geometry.similarities import Similarities
from gsmap.optimize.measurements import Measurements

_SINGLE_WRONG = 0.3  # prior probability that a link of one edge is wrong ...
_GROUP_WRONG = 0.01  # ... and that a link of several agreeing edges is wrong
_NEAR_LENGTHS = 1.25  # two scenes are near each other below this distance, in lengths of a typical edge
_CONCENTRATION = 20.0  # of the Beta distribution of the density of true links, in pairs
_SPARSER = 3.0  # links between places that look alike are sparser than true links by this factor


@dataclass(frozen=True, eq=False)
class Link:
    """A set of edges that connects two parts of a map.

    Args:
        rows: rows of the link's edges.
        moving: (N,) mask of the scenes on the side that would move.
        log_odds_wrong: log-odds that the link is wrong; see `LinkDensity`.
    """

    rows: np.ndarray
    moving: np.ndarray
    log_odds_wrong: float


@dataclass(frozen=True)
class LinkDensity:
    """Density of the edges of a map, with which the density of a link is compared.

    Assumption: a true link has edges as often as any part of the map; a link between places that look alike has edges
    only where registration was mistaken. Consider the pairs of nearby scenes at the ends of a link, one scene from
    either part. For a true link the fraction of pairs with an edge is Beta distributed about the fraction of the whole
    map, for a wrong link about that fraction divided by `_SPARSER`. The assumption fails where every pair of two places
    was mistaken, and where a true link is sparse because few pairs were tried.

    Args:
        length: largest distance of nearby scenes, in map units.
        share: fraction of the pairs of nearby scenes that have an edge.
    """

    length: float
    share: float

    @classmethod
    def of(
        cls,
        edges: Measurements,
        accepted: np.ndarray,
        labels: np.ndarray,
        poses: Similarities,
    ) -> LinkDensity:
        length = _NEAR_LENGTHS * typical_length(edges, poses)
        # Each component has its own frame, so a fourth coordinate separates components.
        apart = np.c_[poses.translations, 10.0 * length * labels]
        near = cKDTree(apart).query_pairs(length, output_type="ndarray")
        pairs = np.bincount(near.ravel(), minlength=edges.num_scenes)
        tied = np.bincount(_tied(edges, np.flatnonzero(accepted), poses, length).ravel(), minlength=edges.num_scenes)
        busy = pairs > 0
        # The median over scenes: where the map is folded, scenes that are no neighbours lie close together.
        share = np.median(tied[busy] / pairs[busy]) if busy.any() else 0.5
        return cls(length, float(np.clip(share, 0.05, 0.9)))

    def link(self, edges: Measurements, rows: np.ndarray, moving: np.ndarray, poses: Similarities) -> Link:
        """Return a link of the edges at ``rows`` with the log-odds that it is wrong."""
        ends = np.unique(np.r_[edges.targets[rows], edges.sources[rows]])
        still = cKDTree(poses.translations[ends[~moving[ends]]])
        pairs = int(still.count_neighbors(cKDTree(poses.translations[ends[moving[ends]]]), self.length))
        tied = min(pairs, len(_tied(edges, rows, poses, self.length)))
        true = _CONCENTRATION * self.share, _CONCENTRATION * (1 - self.share)
        alike = 1.0, _SPARSER / self.share - 1.0
        wrong = _SINGLE_WRONG if len(rows) == 1 else _GROUP_WRONG
        evidence = [betaln(a + tied, b + pairs - tied) - betaln(a, b) for a, b in (alike, true)]
        return Link(rows, moving, float(evidence[0] - evidence[1] + np.log(wrong / (1 - wrong))))


def _tied(edges: Measurements, rows: np.ndarray, poses: Similarities, length: float) -> np.ndarray:
    """Return the pairs (P, 2) of nearby scenes that are connected by the edges at ``rows``."""
    ends = np.sort(np.stack([edges.targets[rows], edges.sources[rows]], axis=1), axis=1)
    near = np.linalg.norm(poses.translations[ends[:, 0]] - poses.translations[ends[:, 1]], axis=1) <= length
    return np.unique(ends[near], axis=0)


def typical_length(edges: Measurements, poses: Similarities) -> float:
    """Compute the median length of the edges in map units; 0 without edges."""
    if not len(edges):
        return 0.0
    unit = np.exp(poses.log_scales[edges.targets])
    return float(np.median(np.linalg.norm(edges.measured.translations, axis=1) * unit))

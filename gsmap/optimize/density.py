"""How densely two parts of a map are tied: what tells places that touch from places that look alike."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import betaln

from gsmap.geometry.similarities import Similarities
from gsmap.optimize.measurements import Measurements

# How likely a link is wrong before its density is looked at: one edge by itself may be any mistake, several that agree
# only a place that looks like another.
ALONE, ALIKE = 0.3, 0.01
# How much the density of true links varies, as the weight of that many pairs; look-alikes are this many times sparser.
SPREAD, SPARSER = 20.0, 3.0
# Scenes nearer than this many typical edges count as near each other.
NEAR = 1.25


@dataclass(frozen=True, eq=False)
class Link:
    """A set of edges that ties two parts of a map: its rows, the side that moves, and the log odds that it is wrong.

    The places of a true link are tied as often as any, those of look-alikes only where the mistake was made: of the
    pairs of a link's end scenes, one of either part, that lie near each other, how many are tied? Under a true link the
    share is Beta distributed about that of the whole map, under look-alikes about a third of it.
    """

    rows: np.ndarray
    moving: np.ndarray
    doubt: float


@dataclass(frozen=True)
class Ties:
    """Up to which ``length`` scenes count as near each other, and the ``share`` of near pairs that is tied."""

    length: float
    share: float

    @classmethod
    def of(cls, edges: Measurements, accepted: np.ndarray, labels: np.ndarray, poses: Similarities) -> Ties:
        length = NEAR * typical_length(edges, poses)
        # Islands have frames of their own: a fourth coordinate keeps them apart.
        apart = np.c_[poses.translations, 10.0 * length * labels]
        near = cKDTree(apart).query_pairs(length, output_type="ndarray")
        pairs = np.bincount(near.ravel(), minlength=edges.num_scenes)
        tied = np.bincount(_tied(edges, np.flatnonzero(accepted), poses, length).ravel(), minlength=edges.num_scenes)
        busy = pairs > 0
        # The median scene's: where the map is folded, scenes that are not neighbours lie together.
        share = np.median(tied[busy] / pairs[busy]) if busy.any() else 0.5
        return cls(length, float(np.clip(share, 0.05, 0.9)))

    def link(self, edges: Measurements, rows: np.ndarray, moving: np.ndarray, poses: Similarities) -> Link:
        """A link by its rows, and how much speaks against it."""
        ends = np.unique(np.r_[edges.targets[rows], edges.sources[rows]])
        still = cKDTree(poses.translations[ends[~moving[ends]]])
        pairs = int(still.count_neighbors(cKDTree(poses.translations[ends[moving[ends]]]), self.length))
        tied = min(pairs, len(_tied(edges, rows, poses, self.length)))
        true = SPREAD * self.share, SPREAD * (1 - self.share)
        alike = 1.0, SPARSER / self.share - 1.0
        wrong = ALONE if len(rows) == 1 else ALIKE
        evidence = [betaln(a + tied, b + pairs - tied) - betaln(a, b) for a, b in (alike, true)]
        return Link(rows, moving, float(evidence[0] - evidence[1] + np.log(wrong / (1 - wrong))))


def _tied(edges: Measurements, rows: np.ndarray, poses: Similarities, length: float) -> np.ndarray:
    """(P, 2) pairs of scenes that edges at ``rows`` tie and that lie near each other."""
    ends = np.sort(np.stack([edges.targets[rows], edges.sources[rows]], axis=1), axis=1)
    near = np.linalg.norm(poses.translations[ends[:, 0]] - poses.translations[ends[:, 1]], axis=1) <= length
    return np.unique(ends[near], axis=0)


def typical_length(edges: Measurements, poses: Similarities) -> float:
    """Median length of an edge in map units; 0 where there is none."""
    if not len(edges):
        return 0.0
    unit = np.exp(poses.log_scales[edges.targets])
    return float(np.median(np.linalg.norm(edges.measured.translations, axis=1) * unit))

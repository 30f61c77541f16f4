"""Compute the number of false alarms (NFA) of a pose: an a contrario test against random correspondences."""

from __future__ import annotations

import numpy as np

from gsmap.register.correspondences import Correspondences
from gsmap.types import NodeLayer, Sim3

_FAR_M = 1e4  # farther than any radius


# A node's context covers its neighbours', so the errors of near correspondences are correlated: the independent trials
# are cells of this size, not nodes.
_CELL_M = 0.5
_HEIGHT_BAND_M = 0.5  # largest height difference of a random partner where gravity is known


def find_inliers(matches: Correspondences, pose: Sim3, radius_m: float) -> np.ndarray:
    """Return an (M,) mask that is True for inliers: correspondences whose two nodes are within the radius of each other
    under the pose. Each node is used once, by its nearest correspondence."""
    distance = np.linalg.norm(pose.apply(matches.source) - matches.target, axis=1)
    keep = np.zeros(len(matches), dtype=bool)
    used_t, used_s = set(), set()
    for i in np.argsort(distance, kind="stable"):
        if distance[i] > radius_m:
            break
        t, s = int(matches.target_ids[i]), int(matches.source_ids[i])
        if t not in used_t and s not in used_s:
            keep[i] = True
            used_t.add(t)
            used_s.add(s)
    return keep


class BackgroundModel:
    """Background model (null hypothesis) of candidate correspondences.

    Under it the partner of each candidate is a random source node of the same type (and of about the same height, where
    gravity is known), and cells are independent. Rooms with the same furniture repeat whole arrangements and violate
    that independence, so the verdict uses a lower threshold than the theory (`gsmap.register.verdict`).

    Args:
        target, source: the layer of each scene.
        source_points_m: (N, 3) positions of the source's nodes, in metres.
        matches: the candidates.
        source_heights: (N,) heights of the source's nodes in metres, or None.
    """

    def __init__(
        self,
        target: NodeLayer,
        source: NodeLayer,
        source_points_m: np.ndarray,
        matches: Correspondences,
        *,
        source_heights: np.ndarray | None = None,
    ) -> None:
        from scipy.spatial import cKDTree

        self.matches = matches
        kinds = target.types[matches.target_ids].astype(np.float64)
        # Nodes of another type lie in another layer of a fourth dimension, so one tree serves all.
        self._layer = kinds * _FAR_M
        self._tree = cKDTree(np.column_stack([source_points_m, source.types * _FAR_M]))
        theirs, own = np.zeros(len(source)), np.zeros(len(matches))
        if source_heights is not None and matches.source_heights is not None:
            theirs, own = source_heights, matches.source_heights
        apart, low = float(np.ptp(theirs)) + 4 * _HEIGHT_BAND_M, theirs.min()
        stacked = np.sort(source.types * apart + (theirs - low))
        own = kinds * apart + (own - low)
        pool = np.searchsorted(stacked, own + _HEIGHT_BAND_M) - np.searchsorted(stacked, own - _HEIGHT_BAND_M)
        self._pool = np.maximum(pool, 1.0)
        _, cell = np.unique(np.floor(matches.target / _CELL_M).astype(int), axis=0, return_inverse=True)
        self._cell = cell.ravel()

    def log10_nfa(self, pose: Sim3, radius_m: float = 0.15) -> float:
        """Return log10 of the number of false alarms: the expected number of poses this good by chance.

        ``log10 C(M, 3) + log10 P[Bin(n - 3, p) >= k - 3]`` (Desolneux, Moisan and Morel 2000), where n cells could hold
        an inlier, k cells hold one, and p is the mean probability that a cell holds one by chance. Each of the C(M, 3)
        triples of candidates gives a pose, with which the triple itself agrees by construction. Below -2 chance does
        not explain the pose; inf for fewer than 4 cells.
        """
        m, cell = len(self.matches), self._cell
        if m < 4:
            return np.inf
        predicted = np.column_stack([pose.inverse().apply(self.matches.target), self._layer])
        near = self._tree.query_ball_point(predicted, radius_m / pose.scale, return_length=True)
        probability = np.minimum(1.0, near / self._pool)
        hits = find_inliers(self.matches, pose, radius_m)
        missed = np.bincount(cell, np.log1p(-np.minimum(probability, 1 - 1e-9)))
        possible = np.bincount(cell, probability > 0) > 0
        n, k = int(possible.sum()), int((np.bincount(cell, hits) > 0).sum())
        if n < 4 or k < 4:
            return np.inf
        p = float((1.0 - np.exp(missed[possible])).mean())
        triples = np.log10(m) + np.log10(m - 1) + np.log10(m - 2) - np.log10(6)
        return float(triples + _log10_binomial_tail(n - 3, k - 3, p))


def _log10_binomial_tail(n: int, k: int, p: float) -> float:
    """Return log10 P[Bin(n, p) >= k], exact far into the tail."""
    from scipy.special import gammaln, logsumexp

    if k <= 0 or p >= 1:
        return 0.0
    if k > n or p <= 0:
        return -np.inf
    j = np.arange(k, n + 1)
    terms = gammaln(n + 1) - gammaln(j + 1) - gammaln(n - j + 1) + j * np.log(p) + (n - j) * np.log1p(-p)
    return float(logsumexp(terms) / np.log(10))

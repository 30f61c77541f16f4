"""Could chance have made this many correspondences agree? The a-contrario answer."""

from __future__ import annotations

import numpy as np

from gsmap.register.correspondences import Correspondences
from gsmap.types import NodeLayer, Sim3


def agreeing(matches: Correspondences, pose: Sim3, radius_m: float) -> np.ndarray:
    """(M,) true for correspondences within the radius under the pose, one to one, nearest first."""
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


def log10_nfa(
    target: NodeLayer,
    source: NodeLayer,
    source_points_m: np.ndarray,
    matches: Correspondences,
    pose: Sim3,
    *,
    radius_m: float = 0.15,
    cell_m: float = 0.5,
    source_heights: np.ndarray | None = None,
    height_band_m: float = 0.5,
) -> float:
    """log10 of the number of false alarms: how many poses this good to expect if partners were drawn at random.

    Under the null each candidate's partner is any source node of its type (and of about its height, where gravity is
    known). A node's context covers its neighbours', so near matches err together: cells of ``cell_m`` are the trials,
    not nodes. With n cells that could agree, mean chance p each, and k that do, every triple of candidates fixing a
    pose: ``log10 C(M, 3) + log10 P[Bin(n - 3, p) >= k - 3]`` (Desolneux, Moisan and Morel 2000; the triple itself
    agrees by construction). Below -2 chance is no explanation.
    """
    from scipy.spatial import cKDTree

    if len(matches) < 4:
        return np.inf
    predicted = pose.inverse().apply(matches.target)
    kinds = target.types[matches.target_ids]
    chance = np.zeros(len(matches))
    for kind in np.unique(kinds):
        rows = np.flatnonzero(kinds == kind)
        nodes = np.flatnonzero(source.types == kind)
        if not len(nodes):
            continue
        near = cKDTree(source_points_m[nodes]).query_ball_point(
            predicted[rows], radius_m / pose.scale, return_length=True
        )
        pool = np.full(len(rows), float(len(nodes)))
        if source_heights is not None and matches.source_heights is not None:
            heights = np.sort(source_heights[nodes])
            own = matches.source_heights[rows]
            pool = np.searchsorted(heights, own + height_band_m) - np.searchsorted(heights, own - height_band_m)
        chance[rows] = np.minimum(1.0, near / np.maximum(pool, 1.0))
    hits = agreeing(matches, pose, radius_m)
    _, cell = np.unique(np.floor(matches.target / cell_m).astype(int), axis=0, return_inverse=True)
    cell = cell.ravel()
    missed = np.bincount(cell, np.log1p(-np.minimum(chance, 1 - 1e-9)))
    possible = np.bincount(cell, chance > 0) > 0
    n, k = int(possible.sum()), int((np.bincount(cell, hits) > 0).sum())
    if n < 4 or k < 4:
        return np.inf
    p = float((1.0 - np.exp(missed[possible])).mean())
    m = len(matches)
    triples = np.log10(m) + np.log10(m - 1) + np.log10(m - 2) - np.log10(6)
    return float(triples + _log10_binomial_tail(n - 3, k - 3, p))


def _log10_binomial_tail(n: int, k: int, p: float) -> float:
    """log10 P[Bin(n, p) >= k], exact far into the tail."""
    from scipy.special import gammaln, logsumexp

    if k <= 0 or p >= 1:
        return 0.0
    if k > n or p <= 0:
        return -np.inf
    j = np.arange(k, n + 1)
    terms = gammaln(n + 1) - gammaln(j + 1) - gammaln(n - j + 1) + j * np.log(p) + (n - j) * np.log1p(-p)
    return float(logsumexp(terms) / np.log(10))

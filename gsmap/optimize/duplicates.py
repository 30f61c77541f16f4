"""Keep duplicates from confirming edges: two scenes made from one capture repeat one measurement.

A chain of duplicates ends at scenes that duplicate nothing, the originals. Each other scene of the chain is a copy. An
edge of a copy measures the same as an edge of its originals, so only one of them is evidence. A copy of several
originals, such as an export that merges them, does not connect its originals if an edge connects them already.
"""

from __future__ import annotations

import numpy as np

from gsmap.optimize.measurements import Measurements


def find_repeated(m: Measurements) -> np.ndarray:
    """Return an (E,) mask of unconfirmed edges that repeat the evidence of another edge."""
    repeated = np.zeros(len(m), dtype=bool)
    if not m.duplicate.any():
        return repeated
    copies = _copies(m)
    originals: dict[int, set[int]] = {}
    for copy in reversed(copies):
        earlier = [scene for scene in _duplicates_of(m, copy) if scene in originals or scene not in copies]
        originals[copy] = set().union(*(originals.get(scene, {scene}) for scene in earlier))
    ends = list(zip(m.targets.tolist(), m.sources.tolist(), strict=True))
    likelihood = np.nan_to_num(m.log_odds_wrong, nan=np.inf)
    first: dict[int, set[int]] = {}  # originals to which a copy is connected by the first of its duplicate edges
    measured: set[tuple[int, int]] = set()

    def rank(row: int) -> tuple[int, bool, bool, float]:
        a, b = ends[row]
        return ((a in originals) + (b in originals), not m.confirmed[row], not m.duplicate[row], likelihood[row])

    for row in sorted(range(len(m)), key=rank):
        a, b = ends[row]
        sides = originals.get(a, {a}), originals.get(b, {b})
        if m.duplicate[row]:
            copy = a if a in originals and (b not in originals or copies.index(a) < copies.index(b)) else b
            other = sides[copy == a]
            if copy not in first:
                first[copy] = other
                continue
            sides = first[copy], other
        pairs = {(min(x, y), max(x, y)) for x in sides[0] for y in sides[1] if x != y}
        repeated[row] = not m.confirmed[row] and (not pairs or not pairs.isdisjoint(measured))
        measured |= pairs
    return repeated


def _copies(m: Measurements) -> list[int]:
    """Return scenes such that every duplicate edge has at least one of them, those with most duplicates first."""
    left = m.duplicate.copy()
    degree = np.bincount(np.r_[m.targets, m.sources], minlength=m.num_scenes)
    out = []
    while left.any():
        count = np.bincount(np.r_[m.targets[left], m.sources[left]], minlength=m.num_scenes)
        # A copy has most duplicates; of two equal ones, the scene with fewer edges is the copy.
        copy = int(np.lexsort((degree, -count))[0])
        out.append(copy)
        left &= (m.targets != copy) & (m.sources != copy)
    return out


def _duplicates_of(m: Measurements, scene: int) -> list[int]:
    rows = m.duplicate & ((m.targets == scene) | (m.sources == scene))
    return np.where(m.targets[rows] == scene, m.sources[rows], m.targets[rows]).tolist()

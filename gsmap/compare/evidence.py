"""What one capture's pictures say of each Gaussian of another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.compare.params import Params

UNSEEN, HIDDEN, SAME, REPAINTED, GONE = 0, 1, 2, 3, 4
"""States of a Gaussian. ``UNSEEN``: the other capture saw too little of the place to say anything. ``HIDDEN``: behind
what the other capture shows. ``SAME``: on the surface that the other shows. ``REPAINTED``: on it, in another colour.
``GONE``: the other looked through it; of a Gaussian of the newer capture that means that it is new."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """For each of N Gaussians of a capture, in how many views of the other it was what.

    Args:
        through, on_surface, hidden: (N,) int32 views.
        sharpness: (N,) float32 as in `Looks`, over the other's views that looked at it or through it.
        colour_seen: (N,) int32 views, of either capture, in which its colour could be compared.
        chroma, lightness: (N, 2) and (N,) float32 means, over these views, of by how much the newer's colour differs.
        state: (N,) int8, one of the five, after neighbours have voted.
    """

    through: np.ndarray
    on_surface: np.ndarray
    hidden: np.ndarray
    sharpness: np.ndarray
    colour_seen: np.ndarray
    chroma: np.ndarray
    lightness: np.ndarray
    state: np.ndarray


class Tally:
    """Counts of evidence, while it is gathered."""

    def __init__(self, count: int) -> None:
        self.through = np.zeros(count, dtype=np.int32)
        self.on_surface = np.zeros(count, dtype=np.int32)
        self.hidden = np.zeros(count, dtype=np.int32)
        self.sharpness = np.zeros(count, dtype=np.float32)
        self.colour_seen = np.zeros(count, dtype=np.int32)
        self.chroma = np.zeros((count, 2), dtype=np.float32)
        self.lightness = np.zeros(count, dtype=np.float32)

    def evidence(self, points: np.ndarray, shows: np.ndarray, params: Params) -> Evidence:
        """The counts and what they come to; ``shows`` (N,) says which Gaussians are part of a surface and vote."""
        often = np.maximum(self.colour_seen, 1).astype(np.float32)
        chroma, lightness = self.chroma / often[:, None], self.lightness / often
        near = _Neighbours(points, shows, params)
        state = self._geometry(near, params)
        same = state == SAME
        seen = same & (self.colour_seen >= 2) & shows
        paint = _painted(points, chroma, lightness, seen, near, params)
        state[same & paint] = REPAINTED
        counts = self.through, self.on_surface, self.hidden, self.sharpness, self.colour_seen
        return Evidence(*counts, chroma, lightness, state)

    def _geometry(self, near: _Neighbours, params: Params) -> np.ndarray:
        through, on = near.sums(self.through), near.sums(self.on_surface)
        judged = self.through + self.on_surface
        few, share = params.min_views, params.min_share
        state = np.full(len(judged), UNSEEN, dtype=np.int8)
        state[self.hidden >= few] = HIDDEN
        # A Gaussian counts as much as all of its neighbours together.
        own = judged / np.maximum(through + on, 1)
        total = judged + own * (through + on)
        part = (self.through + own * through) / np.maximum(total, 1e-9)
        enough = (judged >= 1) & (judged + near.sums(judged) / np.maximum(near.count, 1) >= 2 * few)
        state[enough] = np.where(part[enough] >= share, GONE, SAME)
        return state


class _Neighbours:
    """The nearest Gaussians that show, of each."""

    def __init__(self, points: np.ndarray, shows: np.ndarray, params: Params) -> None:
        from scipy.spatial import cKDTree

        self.rows = np.flatnonzero(shows)
        self.index = np.zeros((len(points), 0), dtype=np.int64)
        self.distance = np.zeros((len(points), 0))
        if len(self.rows):
            tree = cKDTree(points[self.rows])
            count = min(params.neighbours, len(self.rows))
            self.distance, self.index = tree.query(points, count, distance_upper_bound=params.cell_m)
            self.distance, self.index = (v.reshape(len(points), -1) for v in (self.distance, self.index))

    @property
    def count(self) -> np.ndarray:
        """(N,) neighbours within reach."""
        out: np.ndarray = (self.index < len(self.rows)).sum(1)
        return out

    def sums(self, values: np.ndarray) -> np.ndarray:
        """(N, ...) sums of values (N, ...) over the neighbours within reach."""
        padded = np.concatenate([values[self.rows], np.zeros_like(values[:1])])
        out: np.ndarray = padded[self.index].sum(1, dtype=np.float64)
        return out


def _painted(
    points: np.ndarray,
    chroma: np.ndarray,
    lightness: np.ndarray,
    seen: np.ndarray,
    near: _Neighbours,
    params: Params,
) -> np.ndarray:
    """(N,) whether the mean difference of colour around a Gaussian is more than light and noise explain."""
    count = np.maximum(near.sums(seen.astype(np.int32)), 1)
    mean = near.sums(np.where(seen[:, None], np.column_stack([chroma, lightness]), 0)) / count[:, None]
    if not seen.any():
        return np.zeros(len(points), dtype=bool)
    spread = 1.4826 * np.median(np.abs(mean[seen]), axis=0)
    limit = np.maximum([params.min_chroma, params.min_chroma, params.min_lightness], params.colour_spreads * spread)
    out: np.ndarray = (np.abs(mean) > limit).any(1) & (count >= 3)
    return out

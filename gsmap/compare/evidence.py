"""Classify the change of each Gaussian of one capture by evidence from the views of another capture."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsmap.compare.capture_views import CELL_M, MIN_VIEWS
from gsmap.compare.colours import Balance, difference_limits
from gsmap.geometry.morton import morton_order
from gsmap.geometry.neighbours import neighbours_of

UNSEEN, HIDDEN, SAME, REPAINTED, GONE = 0, 1, 2, 3, 4
"""States of a Gaussian. ``UNSEEN``: the other capture observed too little of the place. ``HIDDEN``: occluded in the
other capture. ``SAME``: on a surface of the other capture. ``REPAINTED``: on such a surface, in another colour.
``GONE``: in free space of the other capture; a ``GONE`` Gaussian of the newer capture is new."""


@dataclass(frozen=True, eq=False)
class ChangeEvidence:
    """Evidence on N Gaussians of a capture, counted over the views of another capture.

    Args:
        through, on_surface, hidden: (N,) int32 number of views of the other capture in which a Gaussian lies in free
            space, on the surface, or behind it.
        sure: (N,) int32 number of views in which the Gaussian lies on a well-observed surface or in front of one.
        sharpness: (N,) float32 as in `CaptureViews`, over the other capture's views of the Gaussian.
        colour_seen: (N,) int32 number of views, of either capture, in which the Gaussian's colour could be compared.
        chroma, lightness: (N, 2) and (N,) float32 mean colour differences over these views, newer minus older.
        segment: (N,) int64 segment of Gaussians that are not on floors, ceilings or walls; -1 for the rest.
        framed: (N,) mask of Gaussians that are adjacent to a floor, ceiling or wall without being part of it.
        state: (N,) int8, one of the five states, after voting by neighbours.
    """

    through: np.ndarray
    on_surface: np.ndarray
    hidden: np.ndarray
    sure: np.ndarray
    sharpness: np.ndarray
    colour_seen: np.ndarray
    chroma: np.ndarray
    lightness: np.ndarray
    segment: np.ndarray
    framed: np.ndarray
    state: np.ndarray


_PART = 0.3  # smallest share of the difference of its neighbours that a Gaussian must have itself
_BORDER = 0.4  # smallest fraction of neighbours that changed, for a Gaussian at the border of a change
_ROUNDS = 2
_MIN_AGREEMENT = 0.6  # smallest fraction of the judging views that must see a Gaussian in free space for it to be gone
_MAX_NEIGHBOURS = 16  # largest number of neighbours within `CELL_M` that vote with a Gaussian
CLEAR_M = 0.05  # a root is farther than this from the other capture, because cameras see through blurred surfaces
_ROOT_COLOUR = 2.0  # smallest mean difference around a repainted root, relative to the smallest that counts


class EvidenceCounts:
    """Accumulator of `ChangeEvidence`."""

    def __init__(self, count: int) -> None:
        self.through = np.zeros(count, dtype=np.int32)
        self.on_surface = np.zeros(count, dtype=np.int32)
        self.hidden = np.zeros(count, dtype=np.int32)
        # Views in which it is in front of the surface, perhaps at an edge.
        self.grazed = np.zeros(count, dtype=np.int32)
        # Views in which it is on the surface, but occluded in its own capture.
        self.covered = np.zeros(count, dtype=np.int32)
        self.sure = np.zeros(count, dtype=np.int32)
        self.sharpness = np.zeros(count, dtype=np.float32)
        self.colour_seen = np.zeros(count, dtype=np.int32)
        self.chroma = np.zeros((count, 2), dtype=np.float32)
        self.lightness = np.zeros(count, dtype=np.float32)

    def evidence(
        self,
        points: np.ndarray,
        shows: np.ndarray,
        shell: np.ndarray,
        others: np.ndarray,
        views: int,
        line: Balance,
    ) -> ChangeEvidence:
        """Classify the Gaussians from the counts.

        Args:
            points: (N, 3) means of the Gaussians.
            shows: (N,) mask of Gaussians on surfaces, which vote.
            shell: (N,) wall, floor or ceiling of each Gaussian; see `gsmap.compare.segments.label_shells`.
            others: (M, 3) means of the other capture's Gaussians on surfaces.
            views: number of the other capture's views.
        """
        # Imported here, as it imports scipy, which the recipe key does not need.
        from gsmap.compare.segments import (
            ChangeLabels,
            adjoins_shell,
            find_rooted,
            is_clear,
            label_segments,
            spread_changes,
        )

        often = np.maximum(self.colour_seen, 1).astype(np.float32)
        chroma, lightness = self.chroma / often[:, None], self.lightness / often
        near = _Neighbours(points, shows)
        state = self._geometry(near)
        unchanged = np.where(state == GONE, np.int8(SAME), state)
        # A Gaussian near the other capture's surface may belong to an object in front of that surface.
        beside = near.sums((state == GONE).astype(np.int32)) >= 2
        state[(state == SAME) & (self.covered > self.colour_seen) & (beside | (self.through >= 1))] = GONE
        same = state == SAME
        seen = same & (self.colour_seen >= 1) & shows
        limit = difference_limits(line)
        differs = np.maximum(np.abs(chroma).max(1) / limit[0], np.abs(lightness) / limit[1])
        around = near.mean(np.where(seen, differs, 0), seen)
        state[same & (around >= 1) & (differs >= _PART)] = REPAINTED
        # A small isolated difference is noise; beside a certain change it is the border of that change.
        for _ in range(_ROUNDS):
            beside = near.sums((state >= REPAINTED).astype(np.int32)) >= _BORDER * np.maximum(near.count, 1)
            state[(state == SAME) & beside & (differs >= _PART)] = REPAINTED
        _fill_unjudged(state, near, self.grazed > 0, self.colour_seen < MIN_VIEWS)
        required = min(MIN_VIEWS, views)
        gone = (state == GONE) & (self.through >= required) & ((self.sure >= 1) | (self.on_surface == 0))
        gone[gone] = is_clear(points[gone], others, CLEAR_M)
        painted = (state == REPAINTED) & (self.colour_seen >= required) & (around >= _ROOT_COLOUR) & (differs >= 1)
        # Gaussians in free space are not part of a wall.
        shell = np.where(state == GONE, -1, shell)
        segment = label_segments(points, shell)
        changed, judged, hidden = state >= REPAINTED, state >= SAME, state == HIDDEN
        framed = adjoins_shell(points, shell)
        labels = ChangeLabels(points, shell, segment, changed, gone | painted, judged, hidden, differs, framed)
        stands = find_rooted(labels)
        state[labels.changed & ~stands] = unchanged[labels.changed & ~stands]
        # Spread changes over whole segments.
        state[spread_changes(replace(labels, changed=stands)) & (state < REPAINTED)] = REPAINTED
        counts = self.through, self.on_surface, self.hidden, self.sure, self.sharpness, self.colour_seen
        return ChangeEvidence(*counts, chroma, lightness, segment, framed, state)

    def _geometry(self, near: _Neighbours) -> np.ndarray:
        through, on = near.sums(self.through), near.sums(self.on_surface)
        judged = self.through + self.on_surface
        few, share = MIN_VIEWS, _MIN_AGREEMENT
        state = np.full(len(judged), UNSEEN, dtype=np.int8)
        state[self.hidden >= few] = HIDDEN
        # A Gaussian has as much weight as all its neighbours together.
        own = judged / np.maximum(through + on, 1)
        total = judged + own * (through + on)
        part = (self.through + own * through) / np.maximum(total, 1e-9)
        # One view of a well-observed surface suffices, or a few views of any surface.
        enough = (judged >= 1) & ((self.sure + near.sums(self.sure) >= 1) | (judged >= few))
        state[enough] = np.where(part[enough] >= share, GONE, SAME)
        return state


class _Neighbours:
    """The nearest visible Gaussians of each Gaussian."""

    def __init__(self, points: np.ndarray, shows: np.ndarray) -> None:
        self.rows = np.flatnonzero(shows)
        self.index = np.zeros((len(points), 0), dtype=np.int64)
        if len(self.rows):
            count = min(_MAX_NEIGHBOURS, len(self.rows))
            # Visit Gaussians in Morton order, so that neighbours are in the processor's cache.
            order = morton_order(points)
            self.index = np.empty((len(points), count), dtype=np.int64)
            self.index[order] = neighbours_of(points[self.rows], points[order], count, CELL_M)[1]

    @property
    def count(self) -> np.ndarray:
        """(N,) number of neighbours within reach."""
        out: np.ndarray = (self.index < len(self.rows)).sum(1)
        return out

    def mean(self, values: np.ndarray, of: np.ndarray) -> np.ndarray:
        """Return the (N,) means of values (N,) over those neighbours that are in the mask ``of`` (N,); 0 for fewer than
        three."""
        count = self.sums(of.astype(np.int32))
        out: np.ndarray = np.where(count >= 3, self.sums(np.where(of, values, 0)) / np.maximum(count, 1), 0)
        return out

    def sums(self, values: np.ndarray) -> np.ndarray:
        """Return the (N, ...) sums of values (N, ...) over the neighbours within reach."""
        padded = np.concatenate([values[self.rows], np.zeros_like(values[:1])])
        out: np.ndarray = padded[self.index].sum(1, dtype=np.float64)
        return out


def _fill_unjudged(state: np.ndarray, near: _Neighbours, grazed: np.ndarray, doubtful: np.ndarray) -> None:
    """Give unjudged Gaussians the state of their judged neighbours if most of these are gone or repainted."""
    votes = np.stack([near.sums((state == s).astype(np.int32)) for s in (SAME, REPAINTED, GONE)])
    open_ = (state < SAME) | ((state == SAME) & doubtful)
    most = votes.argmax(0)
    sure = (votes.max(0) >= 3) & (2 * votes.max(0) > votes.sum(0))
    state[(state < SAME) & grazed & ~(sure & (most == 0))] = GONE
    sure &= most > 0
    state[open_ & sure] = np.array([SAME, REPAINTED, GONE], dtype=np.int8)[most[open_ & sure]]

"""What one capture's pictures say of each Gaussian of another."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsmap.compare.colours import Balance, limits
from gsmap.compare.looks import CELL_M, MIN_VIEWS
from gsmap.geometry.morton import morton_order
from gsmap.geometry.neighbours import neighbours_of

UNSEEN, HIDDEN, SAME, REPAINTED, GONE = 0, 1, 2, 3, 4
"""States of a Gaussian. ``UNSEEN``: the other capture saw too little of the place to say anything. ``HIDDEN``: behind
what the other capture shows. ``SAME``: on the surface that the other shows. ``REPAINTED``: on it, in another colour.
``GONE``: the other looked through it; of a Gaussian of the newer capture that means that it is new."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """For each of N Gaussians of a capture, in how many views of the other it was what.

    Args:
        through, on_surface, hidden: (N,) int32 views.
        sure: (N,) int32 views that looked at it or through it and saw that surface well.
        sharpness: (N,) float32 as in `Looks`, over the other's views that looked at it or through it.
        colour_seen: (N,) int32 views, of either capture, in which its colour could be compared.
        chroma, lightness: (N, 2) and (N,) float32 means, over these views, of by how much the newer's colour differs.
        thing: (N,) int64 what it hangs together with off floors, ceilings and walls; -1 for what is on these.
        framed: (N,) bool what lies by one of these without being part of it.
        state: (N,) int8, one of the five, after neighbours have voted.
    """

    through: np.ndarray
    on_surface: np.ndarray
    hidden: np.ndarray
    sure: np.ndarray
    sharpness: np.ndarray
    colour_seen: np.ndarray
    chroma: np.ndarray
    lightness: np.ndarray
    thing: np.ndarray
    framed: np.ndarray
    state: np.ndarray


_PART = 0.3  # of a difference that a Gaussian must have itself, where its neighbours have it
_BORDER = 0.4  # of its neighbours that changed, for a Gaussian to be at a change's border
_ROUNDS = 2
_MIN_AGREEMENT = 0.6  # fraction of the views that could judge a Gaussian, for it to count as gone
_MAX_NEIGHBOURS = 16  # within `CELL_M`, that vote with a Gaussian
CLEAR_M = 0.05  # a root lies farther than this from the other capture: blurred surfaces can be seen through
_ROOT_COLOUR = 2.0  # times the least difference of colour, around a repainted root


class Tally:
    """Counts of evidence, while it is gathered."""

    def __init__(self, count: int) -> None:
        self.through = np.zeros(count, dtype=np.int32)
        self.on_surface = np.zeros(count, dtype=np.int32)
        self.hidden = np.zeros(count, dtype=np.int32)
        self.grazed = np.zeros(
            count, dtype=np.int32
        )  # views in which it is before the surface, though perhaps at an edge
        self.covered = np.zeros(count, dtype=np.int32)  # on the surface, but its own capture shows something before it
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
    ) -> Evidence:
        """The counts and what they come to.

        Args:
            points: (N, 3) of the Gaussians.
            shows: (N,) which of them are part of a surface and vote.
            shell: (N,) wall, floor or ceiling that each is part of; see `gsmap.compare.things.shells`.
            others: (M, 3) of the other capture's Gaussians that are part of a surface.
            views: how many the other capture has.
        """
        # With scipy: naming a recipe has none.
        from gsmap.compare.things import Doubts, by_shell, clear, kin, rooted, things

        often = np.maximum(self.colour_seen, 1).astype(np.float32)
        chroma, lightness = self.chroma / often[:, None], self.lightness / often
        near = _Neighbours(points, shows)
        state = self._geometry(near)
        unchanged = np.where(state == GONE, np.int8(SAME), state)
        # What is near the other's surface, yet part of a thing that stood before it, is no part of that surface.
        beside = near.sums((state == GONE).astype(np.int32)) >= 2
        state[(state == SAME) & (self.covered > self.colour_seen) & (beside | (self.through >= 1))] = GONE
        same = state == SAME
        seen = same & (self.colour_seen >= 1) & shows
        limit = limits(line)
        differs = np.maximum(np.abs(chroma).max(1) / limit[0], np.abs(lightness) / limit[1])
        around = near.mean(np.where(seen, differs, 0), seen)
        state[same & (around >= 1) & (differs >= _PART)] = REPAINTED
        # What differs less, and alone, is noise; beside what is sure it is its border.
        for _ in range(_ROUNDS):
            beside = near.sums((state >= REPAINTED).astype(np.int32)) >= _BORDER * np.maximum(near.count, 1)
            state[(state == SAME) & beside & (differs >= _PART)] = REPAINTED
        _follow(state, near, self.grazed > 0, self.colour_seen < MIN_VIEWS)
        looks = min(MIN_VIEWS, views)
        gone = (state == GONE) & (self.through >= looks) & ((self.sure >= 1) | (self.on_surface == 0))
        gone[gone] = clear(points[gone], others, CLEAR_M)
        painted = (state == REPAINTED) & (self.colour_seen >= looks) & (around >= _ROOT_COLOUR) & (differs >= 1)
        # What one can look through is no wall.
        shell = np.where(state == GONE, -1, shell)
        thing = things(points, shell)
        changed, judged, hidden = state >= REPAINTED, state >= SAME, state == HIDDEN
        framed = by_shell(points, shell)
        doubts = Doubts(points, shell, thing, changed, gone | painted, judged, hidden, differs, framed)
        stands = rooted(doubts)
        state[doubts.changed & ~stands] = unchanged[doubts.changed & ~stands]
        # Whole things, of what turned out to have changed.
        state[kin(replace(doubts, changed=stands)) & (state < REPAINTED)] = REPAINTED
        counts = self.through, self.on_surface, self.hidden, self.sure, self.sharpness, self.colour_seen
        return Evidence(*counts, chroma, lightness, thing, framed, state)

    def _geometry(self, near: _Neighbours) -> np.ndarray:
        through, on = near.sums(self.through), near.sums(self.on_surface)
        judged = self.through + self.on_surface
        few, share = MIN_VIEWS, _MIN_AGREEMENT
        state = np.full(len(judged), UNSEEN, dtype=np.int8)
        state[self.hidden >= few] = HIDDEN
        # A Gaussian counts as much as all of its neighbours together.
        own = judged / np.maximum(through + on, 1)
        total = judged + own * (through + on)
        part = (self.through + own * through) / np.maximum(total, 1e-9)
        # One look at a surface that others of the capture's views saw too, or a few at what none but they saw.
        enough = (judged >= 1) & ((self.sure + near.sums(self.sure) >= 1) | (judged >= few))
        state[enough] = np.where(part[enough] >= share, GONE, SAME)
        return state


class _Neighbours:
    """The nearest Gaussians that show, of each."""

    def __init__(self, points: np.ndarray, shows: np.ndarray) -> None:
        self.rows = np.flatnonzero(shows)
        self.index = np.zeros((len(points), 0), dtype=np.int64)
        if len(self.rows):
            count = min(_MAX_NEIGHBOURS, len(self.rows))
            # Along a curve through them, as their neighbours are then in the cache.
            order = morton_order(points)
            self.index = np.empty((len(points), count), dtype=np.int64)
            self.index[order] = neighbours_of(points[self.rows], points[order], count, CELL_M)[1]

    @property
    def count(self) -> np.ndarray:
        """(N,) neighbours within reach."""
        out: np.ndarray = (self.index < len(self.rows)).sum(1)
        return out

    def mean(self, values: np.ndarray, of: np.ndarray) -> np.ndarray:
        """(N,) means of values (N,) over those neighbours that are among ``of`` (N,), at least three; 0 for fewer."""
        count = self.sums(of.astype(np.int32))
        out: np.ndarray = np.where(count >= 3, self.sums(np.where(of, values, 0)) / np.maximum(count, 1), 0)
        return out

    def sums(self, values: np.ndarray) -> np.ndarray:
        """(N, ...) sums of values (N, ...) over the neighbours within reach."""
        padded = np.concatenate([values[self.rows], np.zeros_like(values[:1])])
        out: np.ndarray = padded[self.index].sum(1, dtype=np.float64)
        return out


def _follow(state: np.ndarray, near: _Neighbours, grazed: np.ndarray, doubtful: np.ndarray) -> None:
    """What nobody judged goes with those around it that were, where most of these are gone or repainted."""
    votes = np.stack([near.sums((state == s).astype(np.int32)) for s in (SAME, REPAINTED, GONE)])
    open_ = (state < SAME) | ((state == SAME) & doubtful)
    most = votes.argmax(0)
    sure = (votes.max(0) >= 3) & (2 * votes.max(0) > votes.sum(0))
    state[(state < SAME) & grazed & ~(sure & (most == 0))] = GONE
    sure &= most > 0
    state[open_ & sure] = np.array([SAME, REPAINTED, GONE], dtype=np.int8)[most[open_ & sure]]

"""What one capture's pictures say of each Gaussian of another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.compare.params import Params
from gsmap.geometry.voxels import voxel_labels

UNSEEN, HIDDEN, SAME, REPAINTED, GONE = 0, 1, 2, 3, 4
"""States of a Gaussian. ``UNSEEN``: the other capture saw too little of the place to say anything. ``HIDDEN``: behind
what the other capture shows. ``SAME``: on the surface that the other shows. ``REPAINTED``: on it, in another colour.
``GONE``: the other looked through it; of a Gaussian of the newer capture that means that it is new."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """For each of N Gaussians of a capture, in how many views of the other it was what.

    Args:
        through, on_surface, hidden: (N,) int32 views.
        colour_differs: (N,) int32 of those where it lies on the surface, here of either capture.
        colour_seen: (N,) int32 views, of either capture, in which its colour could be compared.
        state: (N,) int8, one of the five, after neighbours have voted.
    """

    through: np.ndarray
    on_surface: np.ndarray
    hidden: np.ndarray
    colour_differs: np.ndarray
    colour_seen: np.ndarray
    state: np.ndarray


class Tally:
    """Counts of evidence, while it is gathered."""

    def __init__(self, count: int) -> None:
        self.through = np.zeros(count, dtype=np.int32)
        self.on_surface = np.zeros(count, dtype=np.int32)
        self.hidden = np.zeros(count, dtype=np.int32)
        self.colour_differs = np.zeros(count, dtype=np.int32)
        self.colour_seen = np.zeros(count, dtype=np.int32)

    def evidence(self, points: np.ndarray, shows: np.ndarray, params: Params) -> Evidence:
        """The counts and what they come to; ``shows`` (N,) says which Gaussians are part of a surface and vote."""
        counts = (self.through, self.on_surface, self.hidden, self.colour_differs, self.colour_seen)
        return Evidence(*counts, states(*counts, points, shows, params))


def states(
    through: np.ndarray,
    on_surface: np.ndarray,
    hidden: np.ndarray,
    colour_differs: np.ndarray,
    colour_seen: np.ndarray,
    points: np.ndarray,
    shows: np.ndarray,
    params: Params,
) -> np.ndarray:
    """(N,) int8 states: of each Gaussian by itself, then those of a cell by the majority of what is decided there."""
    judged = through + on_surface
    few, share = params.min_views, params.min_share
    state = np.full(len(points), UNSEEN, dtype=np.int8)
    state[(judged < few) & (hidden >= few)] = HIDDEN
    state[(judged >= few) & (on_surface >= (1 - share) * judged)] = SAME
    paint = (state == SAME) & (colour_seen >= few) & (colour_differs >= share * colour_seen)
    state[paint] = REPAINTED
    state[(through >= few) & (through >= share * judged)] = GONE
    if not len(points):
        return state
    cell = voxel_labels(points, params.cell_m)
    count = int(cell.max()) + 1
    votes = np.stack([np.bincount(cell, shows & (state == s), count) for s in (SAME, REPAINTED, GONE)])
    decided = votes.sum(0)
    # Paint and presence are voted upon in their cell; a cell is only turned over by two thirds of at least three.
    for row, name in enumerate((SAME, REPAINTED, GONE)):
        clear = (votes[row] * 3 >= decided * 2) & (votes[row] >= 3)
        turned = clear[cell] & (state >= SAME)
        state[turned] = name
    return state

"""Which features of a photograph are features of the map: nearest neighbours that agree both ways and stand out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap._native import mutual_nearest
from gsmap.localize.features import UNIT


@dataclass(frozen=True)
class Params:
    """When two features are one.

    Args:
        smooth_px: a photograph loses what is finer (standard deviation of a Gaussian) before its features are found:
            renders show nothing so fine, and one feature of the photo is then one of theirs more often.
        views: that a photograph is matched with, at most, best first.
        more_views: and where that places it nowhere, together with what is finer.
        max_ratio: of the distance to the nearest neighbour and to the view's next one (Lowe 2004).
        max_distance: of unit vectors.
        max_turn: features that were turned otherwise than most others of the view by more than this, in 256ths of a
            full turn, are not the same: a camera is held in one way.
    """

    smooth_px: float = 1.2
    views: int = 24
    more_views: int = 120
    max_ratio: float = 0.85
    max_distance: float = 0.9
    max_turn: int = 18


@dataclass(frozen=True, eq=False)
class Described:
    """Features as they are compared.

    Args:
        descriptors: (N, D) int8 (`gsmap.localize.features.quantised`).
        angles: (N,) uint8 (`gsmap.localize.features.turns`).
    """

    descriptors: np.ndarray
    angles: np.ndarray


def matched(photo: Described, view: Described, params: Params) -> tuple[np.ndarray, np.ndarray]:
    """Mutual nearest neighbours of a photo's features in a view, that stand out from the view's others.

    Returns:
        Rows of the photo's features (K,) and of the view's (K,).
    """
    if len(photo.angles) < 2 or len(view.angles) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    rows, columns, top, next_ = mutual_nearest(photo.descriptors, view.descriptors)
    near, next_ = (np.sqrt(np.maximum(2 - 2 * product / UNIT**2, 0)) for product in (top, next_))
    keep = (near < params.max_ratio * next_) & (near < params.max_distance)
    rows, columns = rows[keep], columns[keep]
    keep = _held_alike(photo.angles[rows], view.angles[columns], params.max_turn)
    return rows[keep], columns[keep]


def _held_alike(photo: np.ndarray, view: np.ndarray, max_turn: int) -> np.ndarray:
    """(K,) bool: pairs whose difference of angles is near the one that is most frequent."""
    if not len(photo):
        return np.zeros(0, bool)
    turn = photo - view  # uint8: a full turn is none
    counts = np.bincount(turn, minlength=256).astype(float)
    window = np.arange(-max_turn, max_turn + 1)
    mode = int(np.argmax(counts[(np.arange(256)[:, None] + window) % 256].sum(1)))
    out: np.ndarray = np.abs((turn - np.uint8(mode)).astype(np.int8).astype(int)) <= max_turn
    return out

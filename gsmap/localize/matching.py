"""Match features by mutual nearest neighbours, the ratio test, and a common rotation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap._native import mutual_nearest
from gsmap.localize.features import UNIT

MAX_RATIO = 0.85
"""Largest ratio of the distances to the nearest and to the second nearest feature of a view (Lowe 2004)."""

MAX_DISTANCE = 0.9
"""Largest distance of two matched unit vectors."""

MAX_TURN = 18
"""Largest difference between a match's rotation and the most frequent rotation of its view, in 256ths of a full
turn."""


@dataclass(frozen=True, eq=False)
class FeatureSet:
    """Descriptors and angles of features, quantized for matching.

    Args:
        descriptors: (N, D) int8 (`gsmap.localize.features.quantize`).
        angles: (N,) uint8 (`gsmap.localize.features.quantize_angles`).
    """

    descriptors: np.ndarray
    angles: np.ndarray


def match_features(photo: FeatureSet, view: FeatureSet) -> tuple[np.ndarray, np.ndarray]:
    """Return the matching rows (K,) of the photo's features and (K,) of the view's features."""
    if len(photo.angles) < 2 or len(view.angles) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    rows, columns, top, next_ = mutual_nearest(photo.descriptors, view.descriptors)
    near, next_ = (np.sqrt(np.maximum(2 - 2 * product / UNIT**2, 0)) for product in (top, next_))
    keep = (near < MAX_RATIO * next_) & (near < MAX_DISTANCE)
    rows, columns = rows[keep], columns[keep]
    keep = _common_rotation(photo.angles[rows], view.angles[columns])
    return rows[keep], columns[keep]


def _common_rotation(photo: np.ndarray, view: np.ndarray) -> np.ndarray:
    """Return a (K,) mask of pairs whose difference of angles is near the most frequent difference."""
    if not len(photo):
        return np.zeros(0, bool)
    turn = photo - view  # uint8 wraps at a full turn
    counts = np.bincount(turn, minlength=256).astype(float)
    window = np.arange(-MAX_TURN, MAX_TURN + 1)
    mode = int(np.argmax(counts[(np.arange(256)[:, None] + window) % 256].sum(1)))
    out: np.ndarray = np.abs((turn - np.uint8(mode)).astype(np.int8).astype(int)) <= MAX_TURN
    return out

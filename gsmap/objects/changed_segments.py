"""Assign changes to segments."""

from __future__ import annotations

import numpy as np

CHANGED = 0.4  # smallest fraction of a segment that changed as a whole; with less, a part or an adjacent object changed


def find_changed_segment(members: np.ndarray, rows: np.ndarray) -> int:
    """Return the segment to which most of the given Gaussians belong, if these are also most of the segment; -1 for
    none."""
    if not len(rows) or rows.max() >= len(members):
        return -1
    mine = members[rows]
    segments, counts = np.unique(mine[mine >= 0], return_counts=True)
    if not len(counts) or 2 * counts.max() <= len(mine):
        return -1
    segment = int(segments[np.argmax(counts)])
    return segment if counts.max() >= CHANGED * np.count_nonzero(members == segment) else -1

"""Assignment of changes to segments."""

from __future__ import annotations

import numpy as np

CHANGED = 0.4  # least fraction of a segment that changed as a whole; less is a part of it, or an adjacent object


def find_changed_segment(members: np.ndarray, rows: np.ndarray) -> int:
    """Return the segment that most of the given Gaussians belong to, and that mostly consists of them; -1 for none."""
    if not len(rows) or rows.max() >= len(members):
        return -1
    mine = members[rows]
    segments, counts = np.unique(mine[mine >= 0], return_counts=True)
    if not len(counts) or 2 * counts.max() <= len(mine):
        return -1
    segment = int(segments[np.argmax(counts)])
    return segment if counts.max() >= CHANGED * np.count_nonzero(members == segment) else -1

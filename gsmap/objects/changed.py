"""Which thing a change is of."""

from __future__ import annotations

import numpy as np

CHANGED = 0.4  # a change of less of a thing is of a part of it, or of what stands against it


def changed_thing(members: np.ndarray, rows: np.ndarray) -> int:
    """The thing that most of some Gaussians are of, and that is mostly of them; -1 for none."""
    if not len(rows) or rows.max() >= len(members):
        return -1
    mine = members[rows]
    things, counts = np.unique(mine[mine >= 0], return_counts=True)
    if not len(counts) or 2 * counts.max() <= len(mine):
        return -1
    thing = int(things[np.argmax(counts)])
    return thing if counts.max() >= CHANGED * np.count_nonzero(members == thing) else -1

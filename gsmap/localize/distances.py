"""Express lengths relative to the distance of what a photo shows.

The same error of a pose in metres moves the image by as many pixels less as its content is farther away. Constants and
models in metres hold for rooms; for content that is farther away they are scaled with its distance.
"""

from __future__ import annotations

import numpy as np

ROOM_M = 3.0
"""Median distance of the content of a photo up to which lengths are not scaled: of photos in synthetic rooms, on which
models are fitted, few show farther content."""


def relative_distance(distances_m: np.ndarray) -> float:
    """Return the factor, at least 1, by which content at some distances is farther away than in a room; invalid
    distances are 0."""
    valid = distances_m[distances_m > 0]
    return max(1.0, float(np.median(valid)) / ROOM_M) if len(valid) else 1.0

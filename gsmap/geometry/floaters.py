"""Detect floaters: points that do not belong to a surface."""

from __future__ import annotations

import numpy as np

from gsmap._native import PointTree

_FAR = 4.0  # times the median distance to the 8th neighbour


def find_floaters(points: np.ndarray, colours: np.ndarray, max_difference: float) -> tuple[np.ndarray, np.ndarray]:
    """Detect points that are isolated or differ in colour from their surroundings.

    A point is isolated when its 8th neighbour lies farther than 4 times the median such distance. Floaters that touch a
    surface are detected by colour: at most one of the 8 neighbours has a similar one.

    Args:
        points: (N, 3), any unit.
        colours: (N, 3) in any colour space with a Euclidean distance.
        max_difference: distance of similar colours.

    Returns:
        (N,) bool mask of floaters, and the (N,) distance to the 8th neighbour; none and 0 for fewer than 9 points.
    """
    if len(points) < 9:
        return np.zeros(len(points), bool), np.zeros(len(points))
    tree = PointTree(np.ascontiguousarray(points, np.float64))
    spacing, unlike = tree.unlike(np.ascontiguousarray(colours, np.float64), 8)
    return (spacing > _FAR * np.median(spacing)) | (unlike >= max_difference), spacing

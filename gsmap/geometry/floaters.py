"""Detect floaters: points that do not belong to a surface."""

from __future__ import annotations

import numpy as np

from gsmap._native import PointTree

_FAR = 4.0  # in multiples of the median distance to the 8th neighbour


def find_floaters(points: np.ndarray, colours: np.ndarray, max_difference: float) -> tuple[np.ndarray, np.ndarray]:
    """Detect points that are isolated or differ in colour from their surroundings.

    A point is isolated if the distance to its 8th neighbour exceeds 4 times the median of these distances. Floaters
    that touch a surface are detected by colour: at most one of the 8 neighbours has a similar colour.

    Args:
        points: (N, 3) points in any unit.
        colours: (N, 3) colours in any space with a Euclidean distance.
        max_difference: largest distance between similar colours.

    Returns:
        An (N,) mask of floaters, and the (N,) distance to the 8th neighbour. With fewer than 9 points the mask is all
        False and the distances are 0.
    """
    if len(points) < 9:
        return np.zeros(len(points), bool), np.zeros(len(points))
    tree = PointTree(np.ascontiguousarray(points, np.float64))
    spacing, unlike = tree.unlike(np.ascontiguousarray(colours, np.float64), 8)
    return (spacing > _FAR * np.median(spacing)) | (unlike >= max_difference), spacing

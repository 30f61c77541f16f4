"""Floaters: points that do not belong to the surface around them."""

from __future__ import annotations

import numpy as np

from gsmap._native import PointTree

_FAR = 4.0  # times the median distance to the 8th neighbour


def find_floaters(points: np.ndarray, colours: np.ndarray, max_difference: float) -> tuple[np.ndarray, np.ndarray]:
    """Which points float alone or have a foreign colour, and how far apart points lie.

    A point floats alone when its 8th neighbour lies farther than 4 times the median such distance. Floaters that touch
    a surface are told by their colour: at most one of the 8 neighbours has one like it.

    Args:
        points: (N, 3), any unit.
        colours: (N, 3) in any space where Euclidean distance means unlikeness.
        max_difference: colours farther apart are unlike.

    Returns:
        (N,) bool, and the distance to the 8th neighbour (N,); nothing floats and distances are 0 below 9 points.
    """
    if len(points) < 9:
        return np.zeros(len(points), bool), np.zeros(len(points))
    tree = PointTree(np.ascontiguousarray(points, np.float64))
    spacing, unlike = tree.unlike(np.ascontiguousarray(colours, np.float64), 8)
    return (spacing > _FAR * np.median(spacing)) | (unlike >= max_difference), spacing

"""Floaters: points that do not belong to the surface around them."""

from __future__ import annotations

import numpy as np

from gsmap.geometry.neighbours import chunks_of_neighbours

_FAR = 4.0  # times the median distance to the 8th neighbour


def find_floaters(points: np.ndarray, colours: np.ndarray, max_difference: float) -> tuple[np.ndarray, np.ndarray]:
    """Which points float alone or have a foreign colour, and how far apart points lie.

    A point floats alone when its 8th neighbour lies farther than 4 times the median such distance. Floaters that touch
    a surface are told by their colour: at most one of the 8 neighbours has one like it.

    Args:
        points: (N, 3), any unit.
        colours: (N, C) in any space where Euclidean distance means unlikeness.
        max_difference: colours farther apart are unlike.

    Returns:
        (N,) bool, and the distance to the 8th neighbour (N,); nothing floats and distances are 0 below 9 points.
    """
    if len(points) < 9:
        return np.zeros(len(points), bool), np.zeros(len(points))
    spacing, foreign = np.empty(len(points)), np.empty(len(points), bool)
    for rows, distances, neighbours in chunks_of_neighbours(points, 9):
        spacing[rows] = distances[:, 8]
        own = colours[rows]
        unlike = np.stack([np.linalg.norm(colours[column] - own, axis=1) for column in neighbours[:, 1:].T])
        foreign[rows] = np.partition(unlike, 1, axis=0)[1] >= max_difference
    return (spacing > _FAR * np.median(spacing)) | foreign, spacing

"""The nearest points of each point of a set."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial import cKDTree

from gsmap.geometry.cells import cell_labels

_ACROSS = 64  # cells of the grid by whose order points are visited
_CHUNK = 100_000  # points that are looked at together: memory stays bounded


def spatial_order(points: np.ndarray, across: int) -> np.ndarray:
    """Rows of the points (N, 3), those in one cell of a grid together; so many cells along the longest side."""
    span = float(np.ptp(points, axis=0).max(initial=0)) if len(points) else 0.0
    if span <= 0:
        return np.arange(len(points))
    return np.argsort(cell_labels(np.floor((points - points.min(0)) * (across / span)))[0], kind="stable")


def chunks_of_neighbours(points: np.ndarray, k: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield rows (M,) of the points (N, 3), and distances and rows (M, k) of the nearest of all points to each, itself
    first; every row once. Where there are fewer than k points, distances are infinite and rows N, as in a k-d tree.

    Points are looked at in the order of a grid's cells, those near each other together: that is twice as fast.
    """
    order = spatial_order(points, _ACROSS)
    ordered, row_of = points[order], np.append(order, len(points))
    tree = cKDTree(ordered, balanced_tree=False)
    for start in range(0, len(points), _CHUNK):
        near, rows = tree.query(ordered[start : start + _CHUNK], k=k)
        yield order[start : start + _CHUNK], near, row_of[rows]


def nearest_neighbours(points: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Distances and rows (N, k) of the nearest of the points (N, 3) to each; see `chunks_of_neighbours`."""
    distances, neighbours = np.zeros((len(points), k)), np.zeros((len(points), k), np.int64)
    for rows, near, found in chunks_of_neighbours(points, k):
        distances[rows], neighbours[rows] = near.reshape(-1, k), found.reshape(-1, k)
    return distances, neighbours

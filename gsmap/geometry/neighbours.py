"""Find nearest neighbours among points."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gsmap._native import PointTree
from gsmap.geometry.boxes import box_around

_ACROSS = 64  # number of cells along the longest side of the grid in whose order points are visited
_CHUNK = 100_000  # number of points per query, which bounds memory


def spatial_order(points: np.ndarray, across: int) -> np.ndarray:
    """Return the rows of the points (N, 3) sorted by the cells of a grid with ``across`` cells along the longest
    side, at most 65,534."""
    low, high = box_around(points) if len(points) else np.zeros((2, 3))
    span = float((high - low).max())
    if span <= 0:
        return np.arange(len(points))
    scale = across / span
    x, y, z = (((points[:, k] - low[k]) * scale).astype(np.uint16) for k in range(3))
    return np.lexsort((z, y, x))  # short keys are sorted by digits


def chunks_of_neighbours(points: np.ndarray, k: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield rows (M,) of points (N, 3) with the distances and rows (M, k) of the points nearest to each, itself first.
    Every row is yielded once. With fewer than k points, distances are infinite and rows N, as in a k-d tree.

    Points are queried in the order of a grid's cells, which is twice as fast.
    """
    from scipy.spatial import cKDTree  # imported here, as the recipe key does not need it

    order = spatial_order(points, _ACROSS)
    ordered, row_of = points[order], np.append(order, len(points))
    tree = cKDTree(ordered, balanced_tree=False)
    for start in range(0, len(points), _CHUNK):
        near, rows = tree.query(ordered[start : start + _CHUNK], k=k)
        yield order[start : start + _CHUNK], near, row_of[rows]


def nearest_neighbours(points: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances and rows (N, k) of the points nearest to each of the points (N, 3); see
    `chunks_of_neighbours`."""
    found: tuple[np.ndarray, np.ndarray] = PointTree(np.ascontiguousarray(points, np.float64)).neighbours(k)
    return found


def neighbours_of(points: np.ndarray, at: np.ndarray, k: int, radius: float = np.inf) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances and rows (M, k) of the points (N, 3) nearest to each query (M, 3) within a radius.

    With fewer points within the radius, distances are inf and rows N. Queries in the order of a space-filling curve
    take half the time.
    """
    tree = PointTree(np.ascontiguousarray(points, np.float64))
    found: tuple[np.ndarray, np.ndarray] = tree.neighbours(k, np.ascontiguousarray(at, np.float64), radius)
    return found


def nearest_of(points: np.ndarray, at: np.ndarray, radius: float = np.inf) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance and row (M,) of the point (N, 3) nearest to each query (M, 3); inf and 0 beyond the
    radius."""
    tree = PointTree(np.ascontiguousarray(points, np.float64))
    found: tuple[np.ndarray, np.ndarray] = tree.nearest(np.ascontiguousarray(at, np.float64), radius)
    return found

"""Group points by the cells of a regular grid, and average them."""

from __future__ import annotations

import math

import numpy as np

from gsmap._native import cell_means as native_cell_means
from gsmap._native import ranks


def cell_labels(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Label equal rows of integer cell coordinates (N, D).

    Returns:
        The (N,) int64 labels, from 0 in the order of the cells (first coordinate first), and the number of rows of each
        label.
    """
    if not len(cells):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    columns = [np.asarray(column).astype(np.int64) for column in cells.T]  # contiguous
    low = [int(column.min()) for column in columns]
    sides = [int(column.max()) - first + 1 for column, first in zip(columns, low, strict=True)]
    if math.prod(sides) >= 2**62:  # with extreme outliers one integer per cell would overflow
        _, label, counts = np.unique(np.stack(columns, axis=1), axis=0, return_inverse=True, return_counts=True)
        return label.reshape(-1), counts
    key = columns[0] - low[0]
    for column, first, side in zip(columns[1:], low[1:], sides[1:], strict=True):
        key *= side
        key += column
        key -= first
    labels, counts = ranks(key)
    return labels, counts


def group_means(values: np.ndarray, labels: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return the (M, F) float64 means of the rows (N, F) of each of M labels; see `cell_labels`."""
    sums = [np.bincount(labels, column, len(counts)) for column in values.T]
    return np.stack(sums, axis=1) / counts[:, None] if len(values) else np.zeros((0, values.shape[1]))


def cell_means(
    points: np.ndarray,
    values: np.ndarray,
    cell: float,
    weights: np.ndarray | None = None,
    origin: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Average points (N, 3) and values (N, 3) over the cells of a grid; return both means (M, 3) and the weights (M,)
    of the cells.

    The result equals `group_means` over `cell_labels`, but takes one pass without intermediate arrays.

    Args:
        cell: edge length of the cells.
        weights: (N,) weights of the points, 1 by default.
        origin: (3,) corner of a cell, 0 by default.
    """
    origin = np.zeros(3) if origin is None else np.asarray(origin, np.float64)
    points, values = np.ascontiguousarray(points, np.float64), np.ascontiguousarray(values, np.float64)
    weights = None if weights is None else np.ascontiguousarray(weights, np.float64)
    try:
        means: tuple[np.ndarray, np.ndarray, np.ndarray] = native_cell_means(
            points=points, values=values, weights=weights, origin=origin[None], cell=cell
        )
        return means
    except OverflowError:  # extreme outliers
        labels, counts = cell_labels(np.floor((points - origin) / cell))
        share = np.ones(len(points)) if weights is None else weights
        total = np.maximum(np.bincount(labels, share, len(counts)), 1e-300)
        both = np.concatenate([points, values], axis=1) * share[:, None]
        mean = group_means(both, labels, total)
        return mean[:, :3], mean[:, 3:], total

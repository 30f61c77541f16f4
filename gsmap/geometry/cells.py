"""Cells of a regular grid: which points share one, and their means."""

from __future__ import annotations

import numpy as np

from gsmap._native import ranks


def cell_labels(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which rows of integer cell coordinates (N, 3) are equal.

    Returns:
        (N,) int64 label of each, counted from 0 in the order of the cells (x, then y, then z); and how many rows each
        label has.
    """
    cells = np.asarray(cells).astype(np.int64)
    if not len(cells):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    cells = cells - cells.min(0)
    sides = cells.max(0) + 1
    if np.prod(sides, dtype=np.float64) >= 2.0**62:  # strays very far out: one number a cell would not hold them
        _, label, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
        return label.reshape(-1), counts
    key = (cells[:, 0] * sides[1] + cells[:, 1]) * sides[2] + cells[:, 2]
    labels, counts = ranks(np.ascontiguousarray(key))
    return labels, counts


def group_means(values: np.ndarray, labels: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """(M, F) float64 means of the rows (N, F) of each of M labels; see `cell_labels`."""
    sums = [np.bincount(labels, column, len(counts)) for column in values.T]
    return np.stack(sums, axis=1) / counts[:, None] if len(values) else np.zeros((0, values.shape[1]))

"""Cluster points by single linkage."""

from __future__ import annotations

import numpy as np

from gsmap._native import clusters


def components(points: np.ndarray, reach_m: float, kind: np.ndarray | None = None) -> np.ndarray:
    """Return the (N,) int64 cluster labels of points (N, 3); points within reach of each other are in one cluster.

    Labels count from 0 in the order of the clusters' first points.

    Args:
        kind: (N,) integers; points of different kinds are never linked.
    """
    kind = None if kind is None else np.ascontiguousarray(kind, np.int64)
    labels: np.ndarray = clusters(np.ascontiguousarray(points, np.float64), reach_m, kind)
    return labels


def groups(
    points: np.ndarray, rows: np.ndarray, reach_m: float, fewest: int, kind: np.ndarray | None = None
) -> list[np.ndarray]:
    """Return the rows of each cluster of at least ``fewest`` points, the largest first."""
    labels = components(points[rows], reach_m, None if kind is None else kind[rows])
    order = np.argsort(labels, kind="stable")
    cuts = np.flatnonzero(np.diff(labels[order])) + 1
    found = [rows[part] for part in np.split(order, cuts) if len(part) >= fewest and len(part)]
    return sorted(found, key=lambda g: (-len(g), int(g[0])))

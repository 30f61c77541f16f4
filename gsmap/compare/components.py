"""Clusters of points."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree


def components(points: np.ndarray, reach_m: float, kind: np.ndarray | None = None) -> np.ndarray:
    """(N,) label of the cluster of each point (N, 3): those within reach of each other are of one.

    Args:
        kind: (N,) of each point; those of different kinds are never linked.
    """
    if not len(points):
        return np.zeros(0, np.int64)
    pairs = cKDTree(points).query_pairs(reach_m, output_type="ndarray")
    if kind is not None:
        pairs = pairs[kind[pairs[:, 0]] == kind[pairs[:, 1]]]
    graph = coo_matrix((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(points),) * 2)
    labels: np.ndarray = connected_components(graph, directed=False)[1].astype(np.int64)
    return labels


def groups(
    points: np.ndarray, rows: np.ndarray, reach_m: float, fewest: int, kind: np.ndarray | None = None
) -> list[np.ndarray]:
    """The rows of points by cluster, large ones first, those of fewer than ``fewest`` points left out."""
    labels = components(points[rows], reach_m, None if kind is None else kind[rows])
    order = np.argsort(labels, kind="stable")
    cuts = np.flatnonzero(np.diff(labels[order])) + 1
    found = [rows[part] for part in np.split(order, cuts) if len(part) >= fewest and len(part)]
    return sorted(found, key=lambda g: (-len(g), int(g[0])))

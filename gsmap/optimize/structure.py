"""Analyse the graph of scenes and edges: components, their first scenes, and bridges."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components, depth_first_order

from gsmap.optimize.measurements import Measurements


def component_labels(edges: Measurements, rows: np.ndarray) -> np.ndarray:
    """Return the (N,) component of each scene, connected by the edges at ``rows``; components are numbered by their
    first scene."""
    n = edges.num_scenes
    graph = sp.coo_matrix((np.ones(len(rows)), (edges.targets[rows], edges.sources[rows])), shape=(n, n))
    labels = connected_components(graph, directed=False)[1]
    _, first = np.unique(labels, return_index=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[labels]


def roots(labels: np.ndarray) -> np.ndarray:
    """Return the first scene of each component."""
    return np.unique(labels, return_index=True)[1]


def bridges(edges: Measurements, accepted: np.ndarray) -> np.ndarray:
    """Return an (E,) mask of bridges: accepted edges on no cycle of accepted edges.

    The edges of a depth-first tree are directed downwards, all remaining edges upwards to an ancestor. Scenes are then
    strongly connected if two edge-disjoint paths connect them (Robbins 1939), and the edges between strongly connected
    sets are the bridges.
    """
    n, rows = edges.num_scenes, np.flatnonzero(accepted)
    ends = np.sort(np.stack([edges.targets[rows], edges.sources[rows]]), axis=0)
    pairs, which, count = np.unique(ends[0] * n + ends[1], return_inverse=True, return_counts=True)
    low, high = pairs // n, pairs % n
    # An additional node above the first scene of every component turns the forest into a tree.
    first = roots(component_labels(edges, rows))
    a, b = np.r_[low, first], np.r_[high, np.full(len(first), n)]
    graph = sp.coo_matrix((np.ones(len(a)), (a, b)), shape=(n + 1, n + 1)).tocsr()
    order, parent = depth_first_order((graph + graph.T).tocsr(), n, directed=False)
    rank = np.empty(n + 1, dtype=np.int64)
    rank[order] = np.arange(n + 1)
    early, late = np.where(rank[a] < rank[b], a, b), np.where(rank[a] < rank[b], b, a)
    down = parent[late] == early
    tail, head = np.where(down, early, late), np.where(down, late, early)
    directed = sp.coo_matrix((np.ones(len(a)), (tail, head)), shape=(n + 1, n + 1)).tocsr()
    blocks = connected_components(directed, directed=True, connection="strong")[1]
    out = np.zeros(len(edges), dtype=bool)
    out[rows] = (blocks[low] != blocks[high])[which] & (count[which] == 1)
    return out


def ranges(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return row k repeated ``counts[k]`` times, and the numbers 0, 1, ... within each row."""
    rows = np.repeat(np.arange(len(counts)), counts)
    offsets = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
    return rows, offsets

"""What stands around an object: a histogram of the features in its neighbourhood of the graph."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree


def neighbourhood(positions: np.ndarray, max_distance: float, hops: int) -> np.ndarray:
    """(M, M) bool: which nodes are within ``hops`` edges of which, itself left out.

    Edges join nodes nearer than ``max_distance``: the paper's local graph.
    """
    count = len(positions)
    step = np.eye(count, dtype=bool)
    for i, j in cKDTree(positions).query_pairs(max_distance) if count else ():
        step[i, j] = step[j, i] = True
    reach = step
    for _ in range(hops - 1):
        reach = (reach.astype(np.float32) @ step.astype(np.float32)) > 0
    return reach & ~np.eye(count, dtype=bool)


def context_histograms(
    features: np.ndarray,
    positions: np.ndarray,
    codebook: np.ndarray,
    *,
    max_distance: float,
    hops: int = 3,
    sharpness: float = 20.0,
) -> np.ndarray:
    """(M, K) unit vectors: how the features around each node spread over the codebook's words.

    A feature is shared among words by the softmax of its similarity; the root of the normalised histogram is
    returned, so that cosines compare as Bhattacharyya coefficients. A node with no neighbour has the zero vector.

    Args:
        features: (M, F) unit vectors.
        positions: (M, 3), any frame.
        codebook: (K, F) unit vectors, the same for every scene.
        max_distance: longest edge of the local graph, the positions' unit.
        hops: how far along it.
        sharpness: of the softmax; the inverse of its temperature.
    """
    if len(features) == 0:
        return np.zeros((0, len(codebook)), np.float32)
    logits = sharpness * features @ codebook.T
    share = np.exp(logits - logits.max(1, keepdims=True))
    share /= share.sum(1, keepdims=True)
    total = neighbourhood(positions, max_distance, hops).astype(np.float64) @ share
    return np.sqrt(total / np.maximum(total.sum(1, keepdims=True), 1e-12)).astype(np.float32)

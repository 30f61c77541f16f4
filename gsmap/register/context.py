"""Append a context to the embeddings of objects: a histogram of the features of neighbouring objects (Graph-GSReg).

The paper uses neighbours within three hops of its local graph; on synthetic places one hop distinguishes objects best.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsmap.settings.ranges import require_range
from gsmap.types import NodeLayer

_LLOYD_STEPS = 10  # of spherical k-means; 5 and 20 steps give the same recall on synthetic places
_MAX_DISTANCE_M = 1.5  # objects nearer to each other are joined in the local graph
NUM_WORDS = 48  # of the codebook, at most
SHARPNESS = 20.0  # inverse temperature of the softmax that assigns a feature to visual words
WEIGHT = 0.5  # length of the context in the embedding, where the feature has length 1


@dataclass(frozen=True)
class Params:
    """Context of objects.

    Args:
        hops: Largest distance from an object to a node of its context, as a number of edges of the local graph, at
            least 1; a larger value describes a larger neighbourhood (Graph-GSReg: 3).
    """

    hops: int = 1

    def __post_init__(self) -> None:
        require_range(self, "[1, inf]", "hops")


def add_context(
    a: NodeLayer,
    b: NodeLayer,
    params: Params | None = None,
    *,
    weight: float = WEIGHT,
    max_distance_m: float = _MAX_DISTANCE_M,
) -> tuple[NodeLayer, NodeLayer]:
    """Return the two layers of one descriptor with new embeddings ``[feature, weight * context]`` of unit length.

    The codebook is computed from the two layers themselves (`word_shares`): an image encoder's features all lie in one
    narrow cone, which a general codebook does not resolve. No context is stored, so the result does not depend on
    further scenes of the map or on their order.
    """
    hops = (params or Params()).hops
    if weight == 0 or not len(a) or not len(b):
        return a, b
    shares = word_shares(np.concatenate([a.features, b.features]), NUM_WORDS, SHARPNESS)
    return (
        _with_embeddings(a, shares[: len(a)], hops, weight, max_distance_m),
        _with_embeddings(b, shares[len(a) :], hops, weight, max_distance_m),
    )


def _with_embeddings(
    layer: NodeLayer, shares: np.ndarray, hops: int, weight: float, max_distance_m: float
) -> NodeLayer:
    reach = neighbourhood(layer.positions, max_distance_m / layer.unit_m, hops)
    both = np.concatenate([layer.features, weight * context_histograms(shares, reach)], axis=1)
    return replace(layer, embeddings=both / np.maximum(np.linalg.norm(both, axis=1, keepdims=True), 1e-12))


def neighbourhood(positions: np.ndarray, max_distance: float, hops: int) -> np.ndarray:
    """Return an (M, M) mask that is True for pairs of different nodes within ``hops`` edges of each other in the local
    graph.

    Edges join nodes nearer than ``max_distance``.
    """
    from scipy.spatial import cKDTree  # imported here, as the recipe key does not need it

    count = len(positions)
    step = np.eye(count, dtype=bool)
    for i, j in cKDTree(positions).query_pairs(max_distance) if count else ():
        step[i, j] = step[j, i] = True
    reach = step
    for _ in range(hops - 1):
        reach = (reach.astype(np.float32) @ step.astype(np.float32)) > 0
    return reach & ~np.eye(count, dtype=bool)


def word_shares(features: np.ndarray, num_words: int, sharpness: float) -> np.ndarray:
    """Assign M features softly to K <= ``num_words`` visual words and return the (M, K) weights, whose rows sum to 1.

    Features are centred on their mean and normalized. Words are the centres of spherical k-means (Dhillon and Modha
    2001) with farthest-point seeds, without randomness. Centres are sums of features, so the Gram matrix of the
    features suffices, whatever their dimension. The weights of a feature are the softmax of its cosines to the words.

    Args:
        features: (M, F).
        num_words: largest K; K is M if there are fewer features.
        sharpness: inverse temperature of the softmax.
    """
    centred = features.astype(np.float64) - features.mean(0, dtype=np.float64)
    centred /= np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), 1e-12)
    gram = centred @ centred.T
    seeds = [int(gram.mean(0).argmax())]
    nearest = gram[seeds[0]]
    for _ in range(min(num_words, len(features)) - 1):
        seeds.append(int(nearest.argmin()))
        nearest = np.maximum(nearest, gram[seeds[-1]])
    cosines = gram[:, seeds]
    for _ in range(_LLOYD_STEPS):
        members = np.zeros_like(cosines)
        members[np.arange(len(members)), cosines.argmax(1)] = 1
        sums = gram @ members
        lengths = np.sqrt((members * sums).sum(0))
        some = lengths > 1e-9  # a word without features keeps its centre
        cosines = np.where(some, sums / np.where(some, lengths, 1), cosines)
    shares = np.exp(sharpness * (cosines - cosines.max(1, keepdims=True)))
    out: np.ndarray = shares / shares.sum(1, keepdims=True)
    return out


def context_histograms(shares: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Return the (M, K) context of each node: the square roots of the visual word histogram of its neighbours, of unit
    length.

    Cosines of square roots are Bhattacharyya coefficients. A node without neighbours has the zero vector.

    Args:
        shares: (M, K) of `word_shares`.
        reach: (M, M) mask, True for pairs of neighbours (`neighbourhood`).
    """
    total = reach.astype(np.float64) @ shares
    out: np.ndarray = np.sqrt(total / np.maximum(total.sum(1, keepdims=True), 1e-12))
    return out

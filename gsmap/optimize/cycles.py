"""Test cycle consistency over triangles: a triangle that closes within its noise supports its three edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from gsmap.geometry.chi_square import chi2_quantile
from gsmap.geometry.similarities import Similarities
from gsmap.optimize.measurements import Measurements
from gsmap.optimize.structure import ranges


@dataclass(frozen=True, eq=False)
class CycleSupport:
    """Cycle support of E edges.

    Args:
        agree: (E,) number of agreeing triangles through each edge.
        support: (E,) of all pairs of a neighbour of the edge's target and a neighbour of its source, the fraction that
            an edge connects (or that are one scene). It is high inside a place, whose scenes share neighbours, and low
            for edges to a place that only looks the same, unless every pair there was mistaken. Only edges with an
            agreeing triangle count.
    """

    agree: np.ndarray
    support: np.ndarray

    def spread(self, rows: np.ndarray, count: int) -> CycleSupport:
        """Extend the support of the edges at ``rows`` to all ``count`` edges; the remaining edges get no support."""
        agree, support = np.zeros(count, dtype=self.agree.dtype), np.zeros(count)
        agree[rows], support[rows] = self.agree, self.support
        return CycleSupport(agree, support)

    @classmethod
    def of(cls, edges: Measurements, agree: np.ndarray) -> CycleSupport:
        n, a, b = edges.num_scenes, edges.targets, edges.sources
        good = np.flatnonzero(agree > 0)
        tied = sp.coo_matrix((np.ones(len(good)), (a[good], b[good])), shape=(n, n)).tocsr()
        tied = ((tied + tied.T) > 0).astype(np.float64)
        own = np.asarray(tied[a, b]).ravel() if len(a) else np.zeros(0)
        degree = np.asarray(tied.sum(1)).ravel()
        two = tied @ tied
        shared = np.asarray(two[a, b]).ravel() if len(a) else np.zeros(0)
        three = np.concatenate(
            [np.zeros(0)]
            + [
                np.asarray(tied[a[k : k + 20_000]].multiply(two[b[k : k + 20_000]]).sum(1)).ravel()
                for k in range(0, len(a), 20_000)
            ]
        )
        # Count paths a - i - j - b, without those that pass the edge a - b itself.
        paths = three - own * (degree[a] + degree[b] - 1)
        # Half of a supporting path out of three is assumed beforehand, so that few neighbours have little effect.
        return cls(agree, (paths + shared + 0.5) / ((degree[a] - own) * (degree[b] - own) + 3.0))


def count_cycle_support(edges: Measurements, probability: float) -> CycleSupport:
    """Count the triangles through every edge that close within their noise.

    A triangle agrees if the chi-square of the product of its three measurements, with their covariances transported to
    one frame, is below the quantile ``probability``. All triangles are computed at once.
    """
    triangles, signs = list_triangles(edges.targets, edges.sources, edges.num_scenes)
    agrees = cycle_chi2(edges, triangles, signs) < chi2_quantile(probability, edges.dim)
    return CycleSupport.of(edges, np.bincount(triangles[agrees].ravel(), minlength=len(edges)))


def list_triangles(targets: np.ndarray, sources: np.ndarray, num_scenes: int) -> tuple[np.ndarray, np.ndarray]:
    """List all triangles of a multigraph.

    Every edge is directed from its scene of lower degree to its scene of higher degree. This bounds the number of pairs
    of edges by E^1.5, however many edges one scene has (Chiba and Nishizeki 1985).

    Returns:
        (T, 3) rows of the edges a-b, b-c and a-c of each triangle, and (T, 3) signs: +1 if the edge is stored as
        (target, source) = (a, b), (b, c) or (c, a), along the cycle a -> b -> c -> a, otherwise -1.
    """
    degree = np.bincount(np.concatenate([targets, sources]), minlength=num_scenes)
    rank = np.empty(num_scenes, dtype=np.int64)
    rank[np.lexsort((np.arange(num_scenes), degree))] = np.arange(num_scenes)
    forward = rank[targets] < rank[sources]
    low, high = np.where(forward, targets, sources), np.where(forward, sources, targets)
    order = np.lexsort((high, low))
    key = low[order] * num_scenes + high[order]

    # Pairs of edges that leave one scene: edge `first` with every later edge of the same scene.
    end = np.searchsorted(low[order], low[order], side="right")
    first, offset = ranges(end - np.arange(len(order)) - 1)
    second = first + 1 + offset
    b, c = high[order][first], high[order][second]
    swap = rank[b] > rank[c]
    b, c = np.where(swap, c, b), np.where(swap, b, c)
    first, second = np.where(swap, second, first), np.where(swap, first, second)

    # The edges that close the triangle; several if more than one edge connects the two scenes.
    start = np.searchsorted(key, b * num_scenes + c, side="left")
    pair, offset = ranges(np.searchsorted(key, b * num_scenes + c, side="right") - start)
    triangles = np.stack([order[first[pair]], order[start[pair] + offset], order[second[pair]]], axis=1)
    signs = np.where(forward[triangles], 1, -1) * np.array([1, 1, -1])
    return triangles, signs


def cycle_chi2(edges: Measurements, cycles: np.ndarray, signs: np.ndarray) -> np.ndarray:
    """Compute the (T,) chi-square, with D degrees of freedom, of the product of the three edges around each triangle.

    The noise of a stored edge is on its source side. If the edge is traversed forwards, that is its far end already; if
    it is traversed backwards, the adjoint moves the noise to the far end. From there the rest of the cycle carries it
    to the start.
    """
    dim = edges.dim
    total = Similarities.identity(len(cycles))
    covariance = np.zeros((len(cycles), dim, dim))
    for k in (2, 1, 0):
        rows, backward = cycles[:, k], signs[:, k] < 0
        step = edges.measured[rows]
        noise = edges.covariance[rows]
        step = step.replaced(backward, step[backward].inverse())
        # Backwards: (Z Exp(xi))^-1 = Exp(-xi) Z^-1 = Z^-1 Exp(-Ad_Z xi).
        adjoint = edges.measured[rows[backward]].adjoint()[:, :dim, :dim]
        noise[backward] = adjoint @ noise[backward] @ adjoint.transpose(0, 2, 1)
        # `total` is the part of the cycle after this edge: Exp(xi) total = total Exp(Ad_total^-1 xi).
        carry = total.inverse().adjoint()[:, :dim, :dim]
        covariance += carry @ noise @ carry.transpose(0, 2, 1)
        total = step @ total
    residual = total.log()[:, :dim]
    return np.einsum("td,td->t", residual, np.linalg.solve(covariance, residual[:, :, None])[:, :, 0])

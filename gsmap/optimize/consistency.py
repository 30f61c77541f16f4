"""Test the pairwise consistency of edges (as in PCM, Mangelson et al. 2018), and their consistency with their
component."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from gsmap.geometry.chi_square import chi2_quantile
from gsmap.geometry.similarities import Similarities
from gsmap.optimize.drift import DriftModel
from gsmap.optimize.measurements import Measurements
from gsmap.optimize.robust import residuals
from gsmap.optimize.structure import ranges


def consistent_with_component(
    edges: Measurements, rows: np.ndarray, drift: DriftModel, probability: float, gates: float = 1.0
) -> np.ndarray:
    """Return a mask over the edges at ``rows`` that is True where an edge agrees with the prediction of its component.

    Args:
        gates: an edge agrees if its chi-square is below ``gates`` times the quantile of ``probability``.
    """
    limit = gates * chi2_quantile(probability, edges.dim)
    out = drift.labels[edges.targets[rows]] == drift.labels[edges.sources[rows]]
    r = residuals(edges[rows], drift.poses)
    for hops in (drift.bound, drift.hops):
        left = np.flatnonzero(out)
        if not len(left):
            break
        a, b = edges.targets[rows[left]], edges.sources[rows[left]]
        out[left] = _chi2(edges.covariance[rows[left]], drift.variances(hops(a, b), b, edges.dim), r[left]) < limit
    return out


@dataclass(frozen=True, eq=False)
class DirectedEdges:
    """Edges as measurements of the pose of their ``far`` scene in the frame of their ``near`` scene.

    Args:
        near, far: (K,) scenes.
        measured: K similarities ``S_near_far``.
        covariance: (K, D, D) on the far side.
    """

    near: np.ndarray
    far: np.ndarray
    measured: Similarities
    covariance: np.ndarray

    @classmethod
    def of(cls, edges: Measurements, rows: np.ndarray, turned: np.ndarray) -> DirectedEdges:
        """Direct the edges at ``rows``: from source to target where ``turned``, otherwise from target to source."""
        a, b, measured, dim = edges.targets[rows], edges.sources[rows], edges.measured[rows], edges.dim
        covariance = edges.covariance[rows].copy()
        adjoint = measured[turned].adjoint()[:, :dim, :dim]
        covariance[turned] = adjoint @ covariance[turned] @ adjoint.transpose(0, 2, 1)
        measured = measured.replaced(turned, measured[turned].inverse())
        return cls(np.where(turned, b, a), np.where(turned, a, b), measured, covariance)

    def pairwise_consistent(
        self, first: np.ndarray, second: np.ndarray, drift: DriftModel, probability: float
    ) -> np.ndarray:
        """Return a (P,) mask that is True if both edges of a pair agree within their noise and the drift of the map
        between them."""
        poses, dim = drift.poses, self.covariance.shape[1]
        a, b, measured, covariance = self.near, self.far, self.measured, self.covariance
        limit = chi2_quantile(probability, dim)
        there = poses[b[second]].inverse() @ poses[b[first]]
        across = poses[a[first]].inverse() @ poses[a[second]]
        r = (measured[first].inverse() @ across @ measured[second] @ there).log()[:, :dim]
        carry = there.inverse().adjoint()[:, :dim, :dim]
        noise = covariance[first] + carry @ covariance[second] @ carry.transpose(0, 2, 1)
        left = np.arange(len(first))
        for measure in (drift.bound, drift.hops):
            f, s = first[left], second[left]
            hops = measure(a[f], a[s]) + measure(b[f], b[s])
            left = left[_chi2(noise[left], drift.variances(hops, b[f], dim), r[left]) < limit]
        out = np.zeros(len(first), dtype=bool)
        out[left] = True
        return out


def agreeing_pairs(
    edges: Measurements, rows: np.ndarray, drift: DriftModel, ends: np.ndarray, probability: float
) -> tuple[np.ndarray, np.ndarray]:
    """Find the pairs of edges between two components that predict the same relative pose; return positions in
    ``rows``."""
    poses, labels = drift.poses, drift.labels
    # Direct every edge from the component of lower number.
    directed = DirectedEdges.of(edges, rows, labels[edges.targets[rows]] > labels[edges.sources[rows]])
    flat = (poses[directed.near] @ directed.measured @ poses[directed.far].inverse()).rotations.reshape(-1, 9)
    spread = 2 * edges.covariance[rows][:, :3, :3].trace(axis1=1, axis2=2).max(initial=0)
    limit = chi2_quantile(probability, edges.dim)
    firsts, seconds = [], []
    counts = ends - np.arange(len(rows)) - 1
    block = np.searchsorted(np.cumsum(counts), np.arange(0, counts.sum() + 1, 2_000_000), side="left")
    block = np.unique(np.r_[0, block, len(rows)])
    for begin, end in itertools.pairwise(block):
        first, offset = ranges(counts[begin:end])
        first = first + begin
        second = first + 1 + offset
        # A cheap first test compares the two predicted orientations of the second component.
        hops = drift.bound(directed.near[first], directed.near[second]) + drift.bound(
            directed.far[first], directed.far[second]
        )
        allowance = np.minimum(limit * (spread + 3 * drift.step[0] * hops), 8.0)
        chord = ((flat[first] - flat[second]) ** 2).sum(1) / 2
        near = chord < allowance
        firsts.append(first[near])
        seconds.append(second[near])
    first, second = np.concatenate(firsts), np.concatenate(seconds)
    same = directed.pairwise_consistent(first, second, drift, probability)
    return first[same], second[same]


def _chi2(covariance: np.ndarray, variances: np.ndarray, r: np.ndarray) -> np.ndarray:
    total = covariance + variances[:, :, None] * np.eye(covariance.shape[1])
    return np.einsum("ed,ed->e", r, np.linalg.solve(total, r[:, :, None])[:, :, 0])

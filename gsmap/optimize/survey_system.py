"""Sparse normal equations of one component with its observations: solve, compute covariances and test observations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from gsmap.geometry.chi_square import chi2_log_survival
from gsmap.geometry.similarities import Similarities
from gsmap.optimize.measurements import Measurements
from gsmap.optimize.priors import PriorTerms
from gsmap.optimize.robust import linearize, residuals
from gsmap.optimize.survey_terms import SurveyTerms, Terms, Unknowns

GATE_PROBABILITY = 0.999  # an observation is an outlier if its chi-square exceeds this quantile
MIN_REDUNDANCY = 1e-3  # directions of an observation with less redundancy are not tested

Active = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""The points, images, fixes and bars that a solution uses, as one (G,) mask of each kind."""


@dataclass(frozen=True, eq=False)
class Component:
    """Scenes, edges and priors of a component, without observations.

    Args:
        scenes: (n,) rows of the component's scenes among all scenes.
        edges: the accepted edges, with rows among all scenes.
        priors: priors of the component's scenes.
        anchor: row of the anchor scene.
        held: (K, dim) whitened directions in which the anchor is fixed, see `gsmap.optimize.gtsam_solve`.
    """

    scenes: np.ndarray
    edges: Measurements
    priors: PriorTerms
    anchor: int
    held: np.ndarray

    @property
    def dim(self) -> int:
        return self.edges.dim

    def local(self) -> Component:
        """Return the component with rows counted among its own scenes."""
        row = np.full(int(self.scenes.max()) + 1, -1)
        row[self.scenes] = np.arange(len(self.scenes))
        ids = tuple(self.edges.scene_ids[k] for k in self.scenes.tolist())
        edges = replace(self.edges, scene_ids=ids, targets=row[self.edges.targets], sources=row[self.edges.sources])
        priors = replace(self.priors, scenes=row[self.priors.scenes])
        return Component(np.arange(len(self.scenes)), edges, priors, int(row[self.anchor]), self.held)


@dataclass(frozen=True, eq=False)
class Factor:
    """Factorized normal equations at an estimate.

    Args:
        lu: LU factors of the matrix, scaled to a unit diagonal.
        root: (size,) square roots of the original diagonal.
    """

    lu: Any
    root: np.ndarray
    dim: int
    num_scenes: int

    def solve(self, rhs: np.ndarray) -> np.ndarray:
        """Solve for right-hand sides (size, K)."""
        with np.errstate(over="ignore"):  # infinite where nothing holds
            out: np.ndarray = self.lu.solve(np.ascontiguousarray(rhs / self.root[:, None])) / self.root[:, None]
        return out

    def columns(self, wanted: np.ndarray) -> np.ndarray:
        """Compute columns (size, K) of the inverse."""
        rhs = np.zeros((len(self.root), len(wanted)))
        rhs[wanted, np.arange(len(wanted))] = 1.0
        return self.solve(rhs)

    def scene_covariances(self) -> np.ndarray:
        """Compute the marginal covariances (n, 7, 7) of the scenes."""
        d = self.dim
        out = np.zeros((self.num_scenes, 7, 7))
        for start in range(0, self.num_scenes, 64):
            rows = np.arange(start, min(start + 64, self.num_scenes))
            found = self.columns((rows[:, None] * d + np.arange(d)).ravel())
            for k, row in enumerate(rows.tolist()):
                block = found[row * d : row * d + d, k * d : k * d + d]
                out[row, :d, :d] = (block + block.T) / 2
        return out

    def joint(self, rows: Sequence[int]) -> np.ndarray:
        """Compute the joint covariance of ``S_world_map`` and of some scenes, 7 rows each."""
        d, world = self.dim, self.num_scenes * self.dim
        places = [world + k for k in range(7)] + [row * d + k for row in rows for k in range(d)]
        found = self.columns(np.array(places))[places]
        into = list(range(7)) + [7 + 7 * i + k for i in range(len(rows)) for k in range(d)]
        out = np.zeros((7 + 7 * len(rows), 7 + 7 * len(rows)))
        out[np.ix_(into, into)] = (found + found.T) / 2
        return out


@dataclass(frozen=True, eq=False)
class ObservationTests:
    """Test statistics of points, images, fixes and bars, (G,) each: the chi-square of an observation against all
    remaining observations, its degrees of freedom, its log p-value, and its redundancy if it is used."""

    statistics: tuple[np.ndarray, ...]
    dofs: tuple[np.ndarray, ...]
    log_p: tuple[np.ndarray, ...]
    redundancies: tuple[np.ndarray, ...]


class System:
    """Least-squares system of one component with its observations."""

    def __init__(self, own: Component, terms: SurveyTerms, scenes: Similarities) -> None:
        self.own, self.terms = own, terms
        self.scenes = scenes
        self.start = scenes[np.array([own.anchor])]
        self.roots = np.linalg.cholesky(own.edges.information).transpose(0, 2, 1) if len(own.edges) else None
        self.size = terms.columns.size
        self.is_check = np.array([point.check for point in terms.points], dtype=bool)
        of_check = self.is_check[terms.image_points] if len(terms.images) else np.zeros(0, dtype=bool)
        self.usable: Active = (
            ~self.is_check,
            ~of_check,
            np.ones(len(terms.fixes), dtype=bool),
            np.ones(len(terms.bars), dtype=bool),
        )
        views = np.bincount(terms.image_points[~of_check], minlength=len(terms.points))
        self.lone = views[terms.image_points] < 2 if len(terms.images) else np.zeros(0, dtype=bool)

    def _edges(self, x: Unknowns) -> tuple[Terms, ...]:
        own, d = self.own, self.own.dim
        out = []
        if len(own.edges) and self.roots is not None:
            r = residuals(own.edges, x.scenes)
            A, B = linearize(own.edges, x.scenes, r)
            whitened = np.einsum("eij,ej->ei", self.roots, r)
            parts = ((own.edges.targets * d, self.roots @ A), (own.edges.sources * d, self.roots @ B))
            out.append(Terms("", whitened, parts, np.ones(len(r), dtype=bool)))
        if len(own.priors):
            r, J = own.priors.linearize(x.scenes)
            out.append(Terms("", r, ((own.priors.scenes * d, J[:, :, :d]),), np.ones(len(r), dtype=bool)))
        if len(own.held):
            off = (self.start.inverse() @ x.scenes[np.array([own.anchor])]).log()[:, :d]
            part = (np.array([own.anchor * d]), own.held[None])
            out.append(Terms("", off @ own.held.T, (part,), np.ones(1, dtype=bool)))
        return tuple(out)

    def _all(self, x: Unknowns, at: Unknowns, weights: Active) -> list[tuple[Terms, np.ndarray]]:
        fixed = [(t, np.ones(len(t.residuals))) for t in (*self._edges(x), *self.terms.others(x, at))]
        return fixed + [(t, w * t.valid) for t, w in zip(self.terms.observations(x), weights, strict=True)]

    def _normal(self, parts: list[tuple[Terms, np.ndarray]]) -> tuple[Any, np.ndarray]:
        rows, cols, data, rhs, count = [], [], [], [], 0
        for terms, weights in parts:
            g, m = terms.residuals.shape
            root = np.sqrt(weights)
            for first, J in terms.parts:
                there = np.flatnonzero((first >= 0) & (weights > 0))
                width = J.shape[2]
                shape = (len(there), m, width)
                rows.append(np.broadcast_to(count + there[:, None, None] * m + np.arange(m)[:, None], shape).ravel())
                cols.append(np.broadcast_to(first[there][:, None, None] + np.arange(width), shape).ravel())
                data.append((J[there] * root[there][:, None, None]).ravel())
            rhs.append((terms.residuals * root[:, None]).ravel())
            count += g * m
        J = sp.csr_matrix(
            (np.concatenate(data), (np.concatenate(rows), np.concatenate(cols))), shape=(count, self.size)
        )
        return (J.T @ J).tocsc(), J.T @ np.concatenate(rhs)

    def _factored(self, H: Any) -> Factor:
        root = np.sqrt(np.maximum(H.diagonal(), 1e-300))
        scaled = sp.diags(1 / root) @ H @ sp.diags(1 / root) + 1e-13 * sp.identity(self.size)
        lu = splu(scaled.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0, options={"SymmetricMode": True})
        return Factor(lu, root, self.own.dim, len(self.scenes))

    def factor(self, x: Unknowns, weights: Active, *, world_held: bool = False) -> Factor:
        """Factorize the normal equations at an estimate.

        Args:
            world_held: ``S_world_map`` is no unknown, because there are no observations.
        """
        H, _ = self._normal(self._all(x, x, self.as_weights(weights)))
        if world_held:
            columns, at = self.terms.columns, np.arange(self.size)
            H = H + sp.diags(((at >= columns.world) & (at < columns.points)).astype(float))
        return self._factored(H)

    def fit(self, x: Unknowns, weights: Active, max_steps: int = 30, *, hold: bool = False) -> Unknowns:
        """Fit by least squares with fixed weights: Gauss-Newton with step halving.

        Args:
            hold: keep the scene poses and ``S_world_map``.
        """
        cost = self._cost(x, x, weights)
        for _ in range(max_steps):
            H, g = self._normal(self._all(x, x, weights))
            if hold:
                free = sp.diags((np.arange(self.size) >= self.terms.columns.points).astype(float))
                H, g = free @ H @ free + sp.identity(self.size) - free, free @ g
            step = -self._factored(H).solve(g[:, None])[:, 0]
            for _ in range(8):
                trial = x.moved(step, self.own.dim)
                trial_cost = self._cost(trial, x, weights)
                if trial_cost <= cost:
                    break
                step = step / 2
            else:
                return x
            gain, cost, x = cost - trial_cost, trial_cost, trial
            if gain <= 1e-10 * cost + 1e-12:
                break
        return x

    def _cost(self, x: Unknowns, at: Unknowns, weights: Active) -> float:
        return float(sum((w * t.squares).sum() for t, w in self._all(x, at, weights)))

    @staticmethod
    def as_weights(active: Active) -> Active:
        points, images, fixes, bars = (one.astype(np.float64) for one in active)
        return points, images, fixes, bars

    def points_at(self, x: Unknowns, active: Active) -> np.ndarray:
        """Triangulate the points whose positions the survey does not fix."""
        met, _, determined = self.terms.triangulate(x, active[1])
        return np.where((determined & ~active[0])[:, None], met, x.points)

    def tests(self, x: Unknowns, active: Active, factor: Factor) -> ObservationTests:
        """Test each observation against all remaining observations (Baarda 1968): compare its residual with the
        covariance predicted from them.

        The chi-square of an observation that the solution uses is ``r^T (Q - A S A^T)^-1 r``, which removes its own
        contribution; for an unused observation it is ``r^T (Q + A S A^T)^-1 r``.
        """
        statistics, dofs, log_p, redundancies = [], [], [], []
        for terms, use in zip(self.terms.observations(x), active, strict=True):
            g, m = terms.residuals.shape
            T, dof, redundancy = np.zeros(g), np.zeros(g, dtype=np.int64), np.zeros(g)
            for start in range(0, g, 128):
                rows = np.arange(start, min(start + 128, g))
                some = Terms(
                    terms.kind,
                    terms.residuals[rows],
                    tuple((first[rows], J[rows]) for first, J in terms.parts),
                    terms.valid[rows],
                )
                J = some.rows(self.size)
                spread = factor.solve(J.reshape(-1, self.size).T).reshape(self.size, len(rows), m)
                own = np.einsum("gas,sgb->gab", J, spread)
                real = J.any(2)
                Q = np.eye(m) + np.where(use[rows], -1.0, 1.0)[:, None, None] * (own + own.transpose(0, 2, 1)) / 2
                values, vectors = np.linalg.eigh(Q)
                along = np.einsum("gab,ga->gb", vectors, some.residuals)
                checked = values > MIN_REDUNDANCY
                T[rows] = np.where(checked, along**2 / np.where(checked, values, 1.0), 0.0).sum(1)
                dof[rows] = np.maximum(0, checked.sum(1) - (~real).sum(1))
                redundancy[rows] = np.maximum(0, np.einsum("gaa->g", Q) - (~real).sum(1))
            T[~terms.valid] = np.inf
            statistics.append(T)
            dofs.append(dof)
            log_p.append(
                np.where(dof > 0, chi2_log_survival(np.where(np.isfinite(T), T, 1e9), np.maximum(dof, 1)), 0.0)
            )
            log_p[-1][~terms.valid] = -1e12
            redundancies.append(np.where(use, redundancy, 0.0))
        return ObservationTests(tuple(statistics), tuple(dofs), tuple(log_p), tuple(redundancies))

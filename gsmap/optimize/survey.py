"""A component tied to the world: scene poses, ``S_world_map`` and control points from edges and observations together.

The map's frame stays held as it was (by its anchor scene, or by priors), and ``S_world_map`` is free: so observations
bend the component where its edges leave room, and never move it as a whole. Everything is solved at once, by
Gauss-Newton on one sparse system, whose inverse then tests every observation against all others and gives covariances.
See docs/design/0037-the-world.md.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu
from scipy.stats import chi2

from gsmap.errors import InputError
from gsmap.geometry.similarities import Similarities
from gsmap.geometry.umeyama import umeyama
from gsmap.optimize.gtsam_solve import held_directions
from gsmap.optimize.measurements import Measurements, all_rigid, measurements
from gsmap.optimize.params import Params, SurveyParams
from gsmap.optimize.priors import PriorTerms
from gsmap.optimize.robust import linearised, residuals
from gsmap.optimize.survey_terms import SurveyTerms, Terms, Unknowns
from gsmap.types import Edge, PoseGraph, Prior, Sim3
from gsmap.types.world import Residual, Survey, WorldFrame, WorldTie

Active = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Which points, images, fixes and bars are solved from, each (G,) bool."""


@dataclass(frozen=True, eq=False)
class Surveyed:
    """A component solved with what was observed of the world.

    Args:
        poses: all scenes; those of other components as given.
        covariances: (n, 7, 7) of the component's scenes, in the map's frame; None where it stays as the edges have it.
        tie: where it lies.
    """

    poses: Similarities
    covariances: np.ndarray | None
    tie: WorldTie


@dataclass(frozen=True, eq=False)
class Component:
    """What a component is solved from besides observations.

    Args:
        scenes: (n,) its rows among all scenes.
        edges: those taken in, between all scenes. priors: those of its scenes.
        anchor: the row that holds its frame.
        held: (K, dim) whitened directions in which the anchor is held, see `gsmap.optimize.gtsam_solve`.
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
        """The same with rows counted within the component."""
        row = np.full(int(self.scenes.max()) + 1, -1)
        row[self.scenes] = np.arange(len(self.scenes))
        ids = tuple(self.edges.scene_ids[k] for k in self.scenes.tolist())
        edges = replace(self.edges, scene_ids=ids, targets=row[self.edges.targets], sources=row[self.edges.sources])
        priors = replace(self.priors, scenes=row[self.priors.scenes])
        return Component(np.arange(len(self.scenes)), edges, priors, int(row[self.anchor]), self.held)


def tie_component(
    whole: Component, poses: Similarities, survey: Survey, index: int, params: SurveyParams, marginal_scenes: int
) -> Surveyed | None:
    """Solve a component with its observations, from poses that its edges alone gave; None where it has none.

    Args:
        index: of the component.
        marginal_scenes: largest number of scenes for which covariances are computed.
    """
    own = whole.local()
    terms = SurveyTerms.of(survey, own.edges.scene_ids, own.dim)
    if not terms:
        return None
    problem = _Problem(own, terms, poses[whole.scenes], params)
    found = problem.solve(survey.frame)
    if isinstance(found, str):
        tie = problem.lengths_only(index, survey, found)
        return Surveyed(poses, None, tie)
    x, active, factor = found
    tie = problem.report(x, active, factor, index, survey.frame)
    covariances = factor.scene_covariances() if len(own.scenes) <= marginal_scenes else None
    return Surveyed(poses.replaced(whole.scenes, x.scenes), covariances, tie)


def joint_of_answer(
    answer: PoseGraph,
    edges: Sequence[Edge],
    priors: Sequence[Prior],
    survey: Survey,
    scenes: Sequence[str],
    component: int,
    params: Params,
) -> np.ndarray | None:
    """See `gsmap.optimize.joint_covariance`. Nothing is solved but for what the observations alone hold."""
    ids = sorted(scene for scene, pose in answer.poses.items() if pose.component == component)
    inside = set(ids)
    mine = [e for e in edges if {e.target, e.source} <= inside and answer.use(e.target, e.source) != "unused"]
    here = [prior for prior in priors if prior.scene in inside]
    here = [prior for prior in here if prior.scene not in answer.provenance.contradicted_priors]
    m = measurements(ids, mine, rigid=all_rigid(mine, here, answer))
    poses = Similarities.stack([answer.poses[scene].S_map_scene for scene in ids])
    rows, terms = np.arange(len(ids)), PriorTerms.stack(ids, here)
    # The scene that holds the frame is the one that is known best.
    sure = [answer.poses[scene].covariance for scene in ids]
    anchor = int(np.argmin([np.inf if c is None else float(np.trace(c)) for c in sure]))
    held = held_directions(m, poses, rows, anchor, terms, params.gauge)
    tie = answer.tie(component)
    tied = tie is not None and tie.S_world_map is not None
    own = SurveyTerms.of(survey if tied else Survey(), m.scene_ids, m.dim)
    problem = _Problem(Component(rows, m, terms, anchor, held), own, poses, params.survey)
    x = own.start(poses, tie.S_world_map if tie is not None and tie.S_world_map is not None else Sim3.identity())
    row = {scene: k for k, scene in enumerate(ids)}
    wanted = [row[scene] for scene in scenes]
    if tie is None or not tied:
        joint = problem.factor(x, problem.usable, world_held=True).joint(wanted)
        joint[:7] = joint[:, :7] = 0.0
        return joint
    active = problem.active_of(tie)
    weights = problem.as_weights(active)
    x = problem.fit(replace(x, points=problem.points_at(x, active)), weights, hold=True)
    return problem.factor(x, weights).joint(wanted)


# --- the sparse system ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Factor:
    """The factorised normal equations at an answer.

    Args:
        lu: of the matrix with a unit diagonal. root: (size,) what its diagonal was divided by.
    """

    lu: Any
    root: np.ndarray
    dim: int
    num_scenes: int

    def solve(self, rhs: np.ndarray) -> np.ndarray:
        """(size, K)."""
        out: np.ndarray = self.lu.solve(np.ascontiguousarray(rhs / self.root[:, None])) / self.root[:, None]
        return out

    def columns(self, wanted: np.ndarray) -> np.ndarray:
        """(size, K) of the inverse."""
        rhs = np.zeros((len(self.root), len(wanted)))
        rhs[wanted, np.arange(len(wanted))] = 1.0
        return self.solve(rhs)

    def scene_covariances(self) -> np.ndarray:
        """(n, 7, 7) marginals of the scenes."""
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
        """Of the world and of scenes, 7 each."""
        d, world = self.dim, self.num_scenes * self.dim
        places = [world + k for k in range(7)] + [row * d + k for row in rows for k in range(d)]
        found = self.columns(np.array(places))[places]
        into = list(range(7)) + [7 + 7 * i + k for i in range(len(rows)) for k in range(d)]
        out = np.zeros((7 + 7 * len(rows), 7 + 7 * len(rows)))
        out[np.ix_(into, into)] = (found + found.T) / 2
        return out


class _Problem:
    """One component and what was observed of it."""

    def __init__(self, own: Component, terms: SurveyTerms, scenes: Similarities, params: SurveyParams) -> None:
        self.own, self.terms, self.params = own, terms, params
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

    # --- linear algebra ----------------------------------------------------------------------------------------------

    def _edges(self, x: Unknowns) -> tuple[Terms, ...]:
        own, d = self.own, self.own.dim
        out = []
        if len(own.edges) and self.roots is not None:
            r = residuals(own.edges, x.scenes)
            A, B = linearised(own.edges, x.scenes, r)
            whitened = np.einsum("eij,ej->ei", self.roots, r)
            parts = ((own.edges.targets * d, self.roots @ A), (own.edges.sources * d, self.roots @ B))
            out.append(Terms("", whitened, parts, np.ones(len(r), dtype=bool)))
        if len(own.priors):
            r, J = own.priors.linearised(x.scenes)
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

    def _factored(self, H: Any) -> _Factor:
        root = np.sqrt(np.maximum(H.diagonal(), 1e-300))
        scaled = sp.diags(1 / root) @ H @ sp.diags(1 / root) + 1e-13 * sp.identity(self.size)
        lu = splu(scaled.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0, options={"SymmetricMode": True})
        return _Factor(lu, root, self.own.dim, len(self.scenes))

    def factor(self, x: Unknowns, weights: Active, *, world_held: bool = False) -> _Factor:
        """The normal equations at an answer.

        Args:
            world_held: ``S_world_map`` is no unknown, for nothing was observed.
        """
        H, _ = self._normal(self._all(x, x, self.as_weights(weights)))
        if world_held:
            columns, at = self.terms.columns, np.arange(self.size)
            H = H + sp.diags(((at >= columns.world) & (at < columns.points)).astype(float))
        return self._factored(H)

    def fit(self, x: Unknowns, weights: Active, max_steps: int = 30, *, hold: bool = False) -> Unknowns:
        """Least squares with fixed weights, by Gauss-Newton with step halving.

        Args:
            hold: scenes and the world stay as they are.
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

    # --- the solve ---------------------------------------------------------------------------------------------------

    def solve(self, frame: WorldFrame | None) -> tuple[Unknowns, Active, _Factor] | str:
        """The answer, what it was solved from, and its system; or what is missing for one."""
        places = self._places()
        if frame is None or not len(places.names):
            return _NOTHING
        if (missing := places.missing(self.params)) is not None:
            return missing
        world, near = places.robust_fit(self.params)
        if (missing := places[near].missing(self.params)) is not None:
            return f"{missing} (the others contradict them)" if not near.all() else missing
        x = self.terms.start(self.scenes, world)
        x = replace(x, points=self._first_points(x))
        gross = places.gross(near, self.terms)
        x, active = self._without_outliers(x, gross)
        factor = self.factor(x, self.as_weights(active))
        return self._weak(factor) or (x, active, factor)

    def _places(self) -> Places:
        """What is known both in the map and in the world, as it lies before anything is bent."""
        terms, x = self.terms, self.terms.start(self.scenes, Sim3.identity())
        in_map, _, told = terms.triangulated(x, self.usable[1])
        chosen = np.flatnonzero(told & ~self.is_check)
        names = [f"control point {terms.points[k].name}" for k in chosen.tolist()]
        names += [f"{fix.name} of a scene" for fix in terms.fixes]
        world = [terms.points[k].position for k in chosen.tolist()] + [fix.position for fix in terms.fixes]
        sigmas = [max(terms.points[k].sigma_m) for k in chosen.tolist()] + [max(fix.sigma_m) for fix in terms.fixes]
        places = np.concatenate([in_map[chosen], terms.fix_points(self.scenes)])
        return Places(
            tuple(names),
            places,
            np.array(world, dtype=np.float64).reshape(-1, 3),
            np.array(sigmas, dtype=np.float64),
            np.r_[chosen, np.full(len(terms.fixes), -1)],
        )

    def _first_points(self, x: Unknowns) -> np.ndarray:
        met, _, told = self.terms.triangulated(x, np.ones(len(self.terms.images), dtype=bool))
        return np.where((told & self.is_check)[:, None], met, x.points)

    def points_at(self, x: Unknowns, active: Active) -> np.ndarray:
        """Points that are not held by their survey, from photos."""
        met, _, told = self.terms.triangulated(x, active[1])
        return np.where((told & ~active[0])[:, None], met, x.points)

    def _without_outliers(self, x: Unknowns, gross: Active) -> tuple[Unknowns, Active]:
        """Graduated non-convexity (Geman-McClure) first; then data snooping: the worst out, what fits again in."""
        active: Active = tuple(use & ~bad for use, bad in zip(self.usable, gross, strict=True))  # type: ignore[assignment]
        x = self.fit(replace(x, points=self.points_at(x, active)), self.as_weights(active), max_steps=3)
        bars = [chi2.ppf(self.params.gate_probability, t.residuals.shape[1]) for t in self.terms.observations(x)]
        wide = max((float((t.squares[a] / b).max(initial=0)) for t, a, b in self._seen(x, active, bars)), default=1.0)
        while True:
            for _ in range(3):
                weights: Active = tuple(  # type: ignore[assignment]
                    a * (wide * b / (wide * b + t.squares)) ** 2 for t, a, b in self._seen(x, active, bars)
                )
                x = self.fit(x, weights, max_steps=2)
            if wide <= 1:
                break
            wide = max(1.0, wide / 4)
        active = tuple(a & (t.squares < 4 * b) & t.valid for t, a, b in self._seen(x, active, bars))  # type: ignore[assignment]
        failures = [np.zeros(len(a), dtype=np.int64) for a in active]
        for _ in range(self.params.max_rounds):
            x = self.fit(replace(x, points=self.points_at(x, active)), self.as_weights(active))
            tests = self.tests(x, active, self.factor(x, self.as_weights(active)))
            if not self._exchange(active, tests, failures):
                break
        return x, active

    def _seen(self, x: Unknowns, active: Active, bars: Sequence[float]) -> list[tuple[Terms, np.ndarray, float]]:
        return list(zip(self.terms.observations(x), active, bars, strict=True))

    def _exchange(self, active: Active, tests: Tests, failures: list[np.ndarray]) -> bool:
        """Leave out the observation that contradicts the others most, or take back one that does not; whether any."""
        worst, place = 0.0, None
        alpha = np.log(1 - self.params.gate_probability)
        for kind, (use, log_p) in enumerate(zip(active, tests.log_p, strict=True)):
            for k in np.flatnonzero(use & (log_p < alpha)).tolist():
                # Of two that say the same the survey of the point is doubted first: it is named first.
                if log_p[k] < worst - 1e-6 * abs(worst) - 1e-9 and not (kind == 1 and self.lone[k]):
                    worst, place = float(log_p[k]), (kind, k)
        if place is not None:
            active[place[0]][place[1]] = False
            failures[place[0]][place[1]] += 1
            return True
        for kind, (use, log_p) in enumerate(zip(active, tests.log_p, strict=True)):
            back = self.usable[kind] & ~use & (log_p > alpha) & (failures[kind] < 2)
            if back.any():
                first = int(np.flatnonzero(back)[np.argmax(log_p[back])])
                use[first] = True
                failures[kind][first] += 1
                return True
        return False

    def tests(self, x: Unknowns, active: Active, factor: _Factor) -> Tests:
        """Each observation against all others (Baarda 1968): the residual by what it can be, given them.

        Of one that was solved from, its own part is taken out: ``r^T (Q - A S A^T)^-1 r``; of another it is not in:
        ``r^T (Q + A S A^T)^-1 r``.
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
                checked = values > self.params.min_redundancy
                T[rows] = np.where(checked, along**2 / np.where(checked, values, 1.0), 0.0).sum(1)
                dof[rows] = np.maximum(0, checked.sum(1) - (~real).sum(1))
                redundancy[rows] = np.maximum(0, np.einsum("gaa->g", Q) - (~real).sum(1))
            T[~terms.valid] = np.inf
            statistics.append(T)
            dofs.append(dof)
            log_p.append(np.where(dof > 0, chi2.logsf(np.where(np.isfinite(T), T, 1e9), np.maximum(dof, 1)), 0.0))
            log_p[-1][~terms.valid] = -1e12
            redundancies.append(np.where(use, redundancy, 0.0))
        return Tests(tuple(statistics), tuple(dofs), tuple(log_p), tuple(redundancies))

    def _weak(self, factor: _Factor) -> str:
        """What the answer leaves open after all."""
        covariance = self._world_covariance(factor)
        values, axes = np.linalg.eigh(covariance[:3, :3])
        turn = float(np.degrees(np.sqrt(max(0.0, values[-1]))))
        if turn > self.params.max_rotation_sigma_deg:
            axis = ", ".join(f"{v:.2f}" for v in axes[:, -1])
            return (
                f"rotation about the map's axis ({axis}) is not determined (known to {turn:.2g} deg): add control "
                "points or positions far from the others, across that axis"
            )
        if np.sqrt(covariance[6, 6]) > self.params.max_log_scale_sigma:
            return (
                f"scale is not determined (known to {100 * np.sqrt(covariance[6, 6]):.2g} %): add control points or "
                "positions further apart, or a scale bar"
            )
        return ""

    def _world_covariance(self, factor: _Factor) -> np.ndarray:
        """(7, 7) of ``S_world_map`` with the anchor's scene taken as exact."""
        joint = factor.joint([self.own.anchor])
        back = self.scenes[np.array([self.own.anchor])]
        # W X: on the scene's side the steps of both add; then back to the map's side.
        to_scene, to_map = back.inverse().adjoint()[0], back.adjoint()[0]
        both = np.concatenate([to_scene, np.eye(7)], axis=1)
        out: np.ndarray = to_map @ both @ joint @ both.T @ to_map.T
        return out

    # --- what it says ------------------------------------------------------------------------------------------------

    def active_of(self, tie: WorldTie) -> Active:
        """What an answer was solved from."""
        out = tie.left_out()
        terms = self.terms
        names = (
            [("point", p.name, "") for p in terms.points],
            [("image", f"{i.point} in {i.image}", i.scene) for i in terms.images],
            [("fix", f.name, f.scene) for f in terms.fixes],
            [("bar", b.name, b.scenes[0]) for b in terms.bars],
        )
        points, images, fixes, bars = (
            np.array([name not in out for name in some], dtype=bool) & use
            for some, use in zip(names, self.usable, strict=True)
        )
        return points, images, fixes, bars

    def report(self, x: Unknowns, active: Active, factor: _Factor, index: int, frame: WorldFrame | None) -> WorldTie:
        """The tie with all residuals."""
        tests = self.tests(x, active, factor)
        rows = self._point_rows(x, active, factor, tests)
        rows += self._image_rows(x, active, tests) + self._fix_rows(x, active, tests) + self._bar_rows(x, active, tests)
        covariance = self._world_covariance(factor)
        factor_of = self._variance_factor(x, active, tests)
        notes = []
        if factor_of > 1:
            notes.append(
                f"observations and edges disagree by {np.sqrt(factor_of):.2g} times what they claim: the covariance "
                "is widened by that"
            )
        if sum(float(tests.redundancies[kind].sum()) for kind in (0, 2, 3)) < self.params.min_checks:
            notes.append("hardly anything checks these observations: a blunder in one of them could not be told")
        world = x.world.item(0)
        return WorldTie(
            index,
            world,
            covariance * factor_of,
            world.scale,
            float(np.sqrt(covariance[6, 6] * factor_of)),
            frame,
            tuple(rows),
            notes=tuple(notes),
        )

    def _variance_factor(self, x: Unknowns, active: Active, tests: Tests) -> float:
        """How much larger residuals are than they claim, where chance does not explain it; at least 1."""
        terms = self.terms.observations(x)
        total = sum(float(t.squares[a].sum()) for t, a in zip(terms, active, strict=True))
        count = sum(int(t.residuals.shape[1] * a.sum()) for t, a in zip(terms, active, strict=True))
        count -= int(
            sum(3 - (2 if i.depth is None else 3) for i, a in zip(self.terms.images, active[1], strict=True) if a)
        )
        unknown = 7 + 3 * len({int(k) for k in self.terms.image_points[active[1]]})
        free = count - unknown
        if free <= 0 or total <= chi2.ppf(self.params.gate_probability, free):
            return 1.0
        return total / free

    def _point_rows(self, x: Unknowns, active: Active, factor: _Factor, tests: Tests) -> list[Residual]:
        show = active[1] | (self.is_check[self.terms.image_points] if len(self.terms.images) else active[1])
        met, picking, told = self.terms.triangulated(x, show)
        at = replace(x, points=met)
        images = self.terms.observations(at)[1]
        rows = []
        for k, point in enumerate(self.terms.points):
            use = "check" if point.check else "used" if active[0][k] else "outlier"
            error: tuple[float, ...] = ()
            sigma: tuple[float, ...] = ()
            statistic, dof, reason = _given(tests.statistics[0][k], tests.dofs[0][k]), int(tests.dofs[0][k]), ""
            if told[k]:
                off = met[k] - point.position
                covariance = picking[k] + self._carried(k, images, picking[k], factor, show)
                error = (float(off[0]), float(off[1]), float(off[2]))
                s = np.sqrt(np.maximum(0, np.diag(covariance)))
                sigma = (float(s[0]), float(s[1]), float(s[2]))
                if point.check:
                    h, v = point.sigma_m
                    statistic, dof = float(off @ np.linalg.solve(covariance + np.diag([h, h, v]) ** 2, off)), 3
            elif point.check or not active[0][k]:
                reason = "no two photos show it, and no surface was rendered where one does"
            if use == "outlier" and not reason:
                reason = "it contradicts the other observations"
            rows.append(Residual("point", point.name, "", use, error, sigma, (), statistic, dof, reason))
        return rows

    def _carried(self, k: int, images: Terms, picking: np.ndarray, factor: _Factor, show: np.ndarray) -> np.ndarray:
        """(3, 3) what a triangulated point gets from poses that are not exact."""
        mine = np.flatnonzero((self.terms.image_points == k) & show & images.valid)
        some = Terms(
            "image", images.residuals[mine], tuple((f[mine], J[mine]) for f, J in images.parts), images.valid[mine]
        )
        J = some.rows(self.size).reshape(-1, self.size)
        by_point = slice(self.terms.columns.points + 3 * k, self.terms.columns.points + 3 * k + 3)
        own = J[:, by_point].copy()
        J[:, by_point] = 0
        carry = -picking @ own.T @ J
        out: np.ndarray = carry @ factor.solve(carry.T)
        return (out + out.T) / 2

    def _image_rows(self, x: Unknowns, active: Active, tests: Tests) -> list[Residual]:
        checked = self.is_check[self.terms.image_points] if len(self.terms.images) else active[1]
        met, _, told = self.terms.triangulated(x, active[1] | checked)
        points = np.where((told & ~active[0])[:, None], met, x.points)
        errors = self.terms.image_errors_px(replace(x, points=points))
        rows = []
        for k, image in enumerate(self.terms.images):
            use = "check" if checked[k] else "used" if active[1][k] else "outlier"
            reason = "it contradicts the other observations" if use == "outlier" else ""
            statistic = None if checked[k] or self.lone[k] else _given(tests.statistics[1][k], tests.dofs[1][k])
            error = (float(errors[k, 0]), float(errors[k, 1])) if abs(errors[k]).max() < 1e6 else ()
            rows.append(
                Residual(
                    "image", f"{image.point} in {image.image}", image.scene, use, (), (), error, statistic,
                    int(tests.dofs[1][k]), reason,
                )
            )  # fmt: skip
        return rows

    def _fix_rows(self, x: Unknowns, active: Active, tests: Tests) -> list[Residual]:
        rows = []
        at = x.world.item(0).apply(self.terms.fix_points(x.scenes))
        for k, fix in enumerate(self.terms.fixes):
            use = "used" if active[2][k] else "outlier"
            off = at[k] - fix.position
            h, v = np.hypot(fix.sigma_m, fix.common_sigma_m)
            rows.append(
                Residual(
                    "fix", fix.name, fix.scene, use, (float(off[0]), float(off[1]), float(off[2])),
                    (float(h), float(h), float(v)), (), _given(tests.statistics[2][k], tests.dofs[2][k]),
                    int(tests.dofs[2][k]), "" if active[2][k] else "it contradicts the other observations",
                )
            )  # fmt: skip
        return rows

    def _bar_rows(self, x: Unknowns, active: Active, tests: Tests) -> list[Residual]:
        rows = []
        terms = self.terms.observations(x)[3]
        for k, bar in enumerate(self.terms.bars):
            use = "used" if active[3][k] else "outlier"
            own = (self.terms._row[bar.scenes[0]], self.terms._row[bar.scenes[1]])
            ends = [x.scenes.item(row).apply(bar.points[e]) for e, row in enumerate(own)]
            length = float(np.linalg.norm(ends[0] - ends[1]) * np.exp(x.world.log_scales[0]))
            off = length - bar.length_m
            sigma = abs(off / terms.residuals[k, 0]) if terms.residuals[k, 0] else bar.sigma_m
            rows.append(
                Residual(
                    "bar", bar.name, bar.scenes[0], use, (off,), (float(sigma),), (),
                    _given(tests.statistics[3][k], tests.dofs[3][k]), int(tests.dofs[3][k]),
                    "" if active[3][k] else "it contradicts the other observations",
                )
            )  # fmt: skip
        return rows

    def lengths_only(self, index: int, survey: Survey, missing: str) -> WorldTie:
        """What scale bars alone tell, where positions do not determine the rest: the metre, and nothing else."""
        terms = self.terms
        rows = [Residual("point", p.name, "", "check" if p.check else "unused", reason=missing) for p in terms.points]
        rows += [Residual("fix", f.name, f.scene, "unused", reason=missing) for f in terms.fixes]
        if not terms.bars:
            return WorldTie(index, frame=survey.frame, residuals=tuple(rows), problem=missing)
        logs, variances = [], []
        for bar in terms.bars:
            poses = [self.scenes.item(terms._row[scene]) for scene in bar.scenes]
            across = float(np.linalg.norm(poses[0].apply(bar.points[0]) - poses[1].apply(bar.points[1])))
            picked = sum((s * pose.scale) ** 2 for s, pose in zip(bar.point_sigmas, poses, strict=True))
            logs.append(np.log(bar.length_m / across))
            variances.append((bar.sigma_m / bar.length_m) ** 2 + picked / across**2)
        log, use = _agreed(np.array(logs), np.array(variances), self.params.gate_probability)
        weights = use / np.array(variances)
        sigma = float(weights.sum() ** -0.5)
        free = int(use.sum()) - 1
        off = float((weights * (np.array(logs) - log) ** 2).sum())
        if free > 0 and off > chi2.ppf(self.params.gate_probability, free):
            sigma *= float(np.sqrt(off / free))
        for bar, one, variance, used in zip(terms.bars, logs, variances, use, strict=True):
            error = bar.length_m * (np.exp(log - one) - 1)
            rows.append(
                Residual(
                    "bar", bar.name, bar.scenes[0], "used" if used else "outlier", (float(error),),
                    (float(bar.length_m * np.sqrt(variance)),), reason="" if used else "the other bars contradict it",
                )
            )  # fmt: skip
        return WorldTie(index, None, None, float(np.exp(log)), sigma, survey.frame, tuple(rows), problem=missing)


_NOTHING = (
    "position, rotation and scale are not determined: it takes three control points that photos of the map show, or "
    "positions of cameras or scenes, that are not on one line"
)


@dataclass(frozen=True, eq=False)
class Tests:
    """By points, images, fixes and bars: (G,) chi-square against all others, its degrees of freedom, the logarithm of
    the probability of one as large, and of those that were solved from the redundancy: in how many directions others
    check them."""

    statistics: tuple[np.ndarray, ...]
    dofs: tuple[np.ndarray, ...]
    log_p: tuple[np.ndarray, ...]
    redundancies: tuple[np.ndarray, ...]


@dataclass(frozen=True, eq=False)
class Places:
    """P places known in the map and in the world.

    Args:
        names: for people. in_map, in_world: (P, 3). sigma_m: (P,).
        rows: (P,) of the control point; -1 of a fix.
    """

    names: tuple[str, ...]
    in_map: np.ndarray
    in_world: np.ndarray
    sigma_m: np.ndarray
    rows: np.ndarray

    def __getitem__(self, keep: np.ndarray) -> Places:
        names = tuple(name for name, k in zip(self.names, keep.tolist(), strict=True) if k)
        return Places(names, self.in_map[keep], self.in_world[keep], self.sigma_m[keep], self.rows[keep])

    def missing(self, params: SurveyParams) -> str | None:
        """What they do not determine, and what would; None where they determine everything."""
        n = len(self.names)
        if not n:
            return _NOTHING
        if n == 1:
            return (
                f"rotation and scale are not determined: only {self.names[0]} is known both in the map and in the "
                "world; add two more that are not on one line with it"
            )
        sigma = float(np.sqrt((self.sigma_m**2).mean()))
        spread = np.minimum(*[_spread(points, size) for points, size in self._in_metres()])
        if spread[0] < 3 * sigma:
            return (
                f"rotation and scale are not determined: {_listed(self.names)} lie at one place within their errors; "
                f"add others further off than {3 * sigma:.2g} m"
            )
        limit = np.radians(params.max_rotation_sigma_deg)
        if n == 2 or spread[1] < sigma / limit:
            turn = (
                "" if n == 2 else f" (known to {min(180.0, float(np.degrees(sigma / max(spread[1], 1e-12)))):.2g} deg)"
            )
            return (
                f"rotation about the line through {_listed(self.names)} is not determined{turn}: add a control point "
                f"or position at least {sigma / limit:.2g} m off that line, better as far as they are apart"
            )
        return None

    def _in_metres(self) -> list[tuple[np.ndarray, float]]:
        """World and map, the map as large as the world: a blunder may put on a line what is not, or the reverse."""
        size = float(np.median(np.linalg.norm(self.in_map - np.median(self.in_map, axis=0), axis=1)))
        true = float(np.median(np.linalg.norm(self.in_world - np.median(self.in_world, axis=0), axis=1)))
        return [(self.in_world, 1.0), (self.in_map, true / size if size > 0 and true > 0 else 1.0)]

    def robust_fit(self, params: SurveyParams) -> tuple[Sim3, np.ndarray]:
        """``S_world_map`` that most of them agree with, and (P,) bool which do.

        Every triple is tried, or so many of them; what agrees is what lies within its error and the drift of a map.
        """
        n = len(self.names)
        middle = np.median(self.in_world, axis=0)
        extent = 2 * float(np.median(np.linalg.norm(self.in_world - middle, axis=1)))
        bar = 5 * self.sigma_m + params.drift_share * extent
        triples = list(itertools.combinations(range(n), 3)) if n <= 15 else self._drawn(params.draws)
        best, least = None, np.inf
        for three in triples:
            rows = list(three)
            try:
                S = umeyama(self.in_world[rows], self.in_map[rows], with_scale=True)
            except InputError:
                continue
            if _spread(self.in_map[rows], 1.0)[1] < 0.02 * _spread(self.in_map[rows], 1.0)[0]:
                continue
            cost = float(np.minimum(self._off(S) / bar, 1).sum())
            if cost < least - 1e-9:
                best, least = S, cost
        if best is None:
            best = umeyama(self.in_world, self.in_map, with_scale=True)
        near = self._off(best) < bar
        for _ in range(5):
            if near.sum() < 3:
                break
            best = umeyama(self.in_world[near], self.in_map[near], with_scale=True, weights=bar[near] ** -2)
            again = self._off(best) < bar
            if (again == near).all():
                break
            near = again
        return best, near

    def _drawn(self, count: int) -> list[tuple[int, ...]]:
        rng = np.random.default_rng(0)
        return [tuple(rng.choice(len(self.names), 3, replace=False).tolist()) for _ in range(count)]

    def _off(self, S: Sim3) -> np.ndarray:
        out: np.ndarray = np.linalg.norm(S.apply(self.in_map) - self.in_world, axis=1)
        return out

    def gross(self, near: np.ndarray, terms: SurveyTerms) -> Active:
        """Observations that are far from what most agree on: left out before anything is bent to them."""
        points = np.zeros(len(terms.points), dtype=bool)
        of_points = self.rows >= 0
        points[self.rows[of_points & ~near]] = True
        none = np.zeros(len(terms.images), dtype=bool), np.zeros(len(terms.bars), dtype=bool)
        return points, none[0], ~near[~of_points], none[1]


def _spread(points: np.ndarray, size: float) -> np.ndarray:
    """(3,) root of the sum of squares along the principal axes, largest first."""
    found = np.linalg.svd((points - points.mean(0)) * size, compute_uv=False)
    return np.r_[found, np.zeros(3)][:3]


def _agreed(logs: np.ndarray, variances: np.ndarray, probability: float) -> tuple[float, np.ndarray]:
    """The mean of those that agree, and which do: where three or more are there, those far from the median go."""
    use = np.ones(len(logs), dtype=bool)
    if len(logs) >= 3:
        use = (logs - np.median(logs)) ** 2 <= chi2.ppf(probability, 1) * (variances + np.median(variances))
    weights = use / variances
    return float((weights * logs).sum() / weights.sum()), use


def _given(value: float, dof: int) -> float | None:
    return float(value) if dof > 0 and np.isfinite(value) else None


def _listed(names: Sequence[str], most: int = 4) -> str:
    shown = list(names[:most])
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return (", ".join(shown[:-1]) + " and " + shown[-1] if len(shown) > 1 and not more else ", ".join(shown)) + more

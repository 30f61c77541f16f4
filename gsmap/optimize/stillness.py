"""Leaving alone what an answer did not change: solved anew, every pose differs from the last one by rounding."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmap.geometry.similarities import Similarities
from gsmap.optimize.params import Params
from gsmap.types import Edge, EdgeOutcome, PoseGraph, ScenePose, Sim3

_MAX_VARIANCE_CHANGE = 1e-2  # of covariances as a fraction of the variances, and of chi-squares of edges
_ROUNDING = 1e-9  # rad, scene units, log scale: a step that no pose was ever known to
_ROUNDS = 20  # of letting go what a group of scenes that moved tears at; then none of the component stays
_SEAM = 10.0  # times what an edge may be off inside: around a group of scenes that moved, the small steps add up


def kept_still(answer: PoseGraph, previous: PoseGraph | None, edges: Sequence[Edge], params: Params) -> PoseGraph:
    """The answer, with poses, covariances and chi-squares of the previous one where they are the same for all purposes.

    A scene keeps its pose where the new one is within ``params.max_unchanged_sigmas`` of its standard deviations, and
    where that holds of its place beside each neighbour, too, by what the edge between them leaves open: far from the
    anchor a rounding turns all scenes together, which moves each by more than neighbours are known to each other, and
    none beside another. Scenes that did move are put to those that stay as the answer has them beside each other.

    What is kept is compared with an answer from all edges every time, so that small steps do not add up.

    Args:
        previous: the last answer; None keeps nothing.
        edges: those that the answer rests on; at least those of all scenes whose pose is not the very object of before,
            and of those beside them that give way.
        params: ``max_unchanged_sigmas`` is used.
    """
    if previous is None or not answer.poses:
        return answer
    used = [e for e in edges if answer.use(e.target, e.source) != "unused"]
    # Where new scenes were placed one by one, all but a few poses are the very ones of before.
    changed = {scene for scene, pose in answer.poses.items() if previous.poses.get(scene) is not pose}
    graph = _Both.of(answer, previous, changed.union(*((e.target, e.source) for e in used)), used)
    still = graph.still(answer, params.max_unchanged_sigmas)
    poses = dict(answer.poses)
    for row, S_map_scene in graph.beside(still, params.max_unchanged_sigmas).items():
        scene = graph.scenes[row]
        poses[scene] = replace(poses[scene], S_map_scene=S_map_scene)
    for row in np.flatnonzero(still).tolist():
        scene = graph.scenes[row]
        poses[scene] = _kept(poses[scene], previous.poses[scene], _MAX_VARIANCE_CHANGE)
    outcomes = {
        pair: _kept_outcome(outcome, previous.outcomes.get(pair), _MAX_VARIANCE_CHANGE)
        for pair, outcome in answer.outcomes.items()
    }
    return replace(answer, poses=poses, outcomes=outcomes)


@dataclass(frozen=True, eq=False)
class _Both:
    """N scenes by id as they lie now and lay before, and the E edges in use between them.

    Args:
        known: (N,) bool, scenes that had a pose before; ``before`` has the new one for the others.
        targets, sources: (E,) rows of ``scenes``.
        information: (E, 7, 7).
        component: (N,).
    """

    scenes: list[str]
    now: Similarities
    before: Similarities
    known: np.ndarray
    targets: np.ndarray
    sources: np.ndarray
    information: np.ndarray
    component: np.ndarray

    @classmethod
    def of(cls, answer: PoseGraph, previous: PoseGraph, among: Collection[str], edges: Sequence[Edge]) -> _Both:
        scenes = sorted(s for s in among if s in answer.poses and answer.poses[s].S_map_scene is not None)
        row = {scene: k for k, scene in enumerate(scenes)}
        now = [answer.poses[scene].S_map_scene for scene in scenes]
        then = [previous.poses.get(scene) for scene in scenes]
        known = np.array([pose is not None and pose.S_map_scene is not None for pose in then], dtype=bool)
        before = [
            S if pose is None or pose.S_map_scene is None else pose.S_map_scene
            for S, pose in zip(now, then, strict=True)
        ]
        mine = [e for e in edges if e.target in row and e.source in row]
        return cls(
            scenes,
            Similarities.stack(now),
            Similarities.stack(before),
            known,
            np.array([row[e.target] for e in mine], dtype=np.int64),
            np.array([row[e.source] for e in mine], dtype=np.int64),
            np.array([e.information for e in mine], dtype=np.float64).reshape(-1, 7, 7),
            np.array([answer.poses[scene].component for scene in scenes], dtype=np.int64),
        )

    def still(self, answer: PoseGraph, sigmas: float) -> np.ndarray:
        """(N,) bool: scenes that need not move."""
        steps = (self.before.inverse() @ self.now).log()
        covariances = [answer.poses[scene].covariance for scene in self.scenes]
        sigma = np.array([np.zeros(7) if c is None else np.sqrt(np.maximum(np.diag(c), 0)) for c in covariances])
        tied = np.zeros(len(self.scenes), dtype=bool)
        tied[self.targets] = tied[self.sources] = True
        free = tied & np.array([c is None for c in covariances], dtype=bool)  # only its neighbours tell
        still = self.known & (free | (np.abs(steps) <= _ROUNDING + sigmas * sigma).all(1))
        inside = still[self.targets] & still[self.sources]
        off = self._off(self.before, inside) > sigmas
        still[self.targets[inside][off]] = still[self.sources[inside][off]] = False
        return still

    def beside(self, still: np.ndarray, sigmas: float) -> dict[int, Sim3]:
        """Poses, by row, of the scenes that moved: each group of them put to a scene beside it that stays.

        Where that leaves a gap to another one that stays, that one moves, too; ``still`` says so then.
        """
        ends = np.stack([self.targets, self.sources])
        for _ in range(_ROUNDS):
            poses, rows = self._put_beside(still)
            seam = np.flatnonzero(still[ends[0]] ^ still[ends[1]])
            torn = seam[self._off(poses, seam) > _SEAM * sigmas]
            if not len(torn):
                break
            still[ends[:, torn]] = False
        else:
            still[np.isin(self.component, self.component[ends[0, torn]])] = False
            poses, rows = self._put_beside(still)
        return {row: poses.item(row) for row in rows.tolist()}

    def _put_beside(self, still: np.ndarray) -> tuple[Similarities, np.ndarray]:
        """All poses then, and the rows of those that are neither as they were nor as the answer has them."""
        ends, n = np.stack([self.targets, self.sources]), len(self.scenes)
        moved = ~still[ends].any(0)
        import scipy.sparse as sp  # naming a recipe does without
        from scipy.sparse.csgraph import connected_components

        tied = sp.coo_matrix((np.ones(moved.sum()), ends[:, moved]), shape=(n, n))
        group = connected_components(tied, directed=False)[1]
        seam = still[ends[0]] ^ still[ends[1]]
        stays = np.where(still[ends[0]], ends[0], ends[1])[seam]
        goes = np.where(still[ends[0]], ends[1], ends[0])[seam]
        contact = np.full(n, n)
        np.minimum.at(contact, group[goes], stays)  # the first by id: whatever the order of edges
        loose = np.flatnonzero(~still)
        poses = self.before.replaced(loose, self.now[loose])
        rows = loose[contact[group[loose]] < n]
        by = contact[group[rows]]
        back = self.before[by] @ self.now[by].inverse()
        return poses.replaced(rows, (back @ self.now[rows]).orthonormalised()), rows

    def _off(self, poses: Similarities, which: np.ndarray) -> np.ndarray:
        """(K,) how far some edges are from where the answer has them, in standard deviations."""
        a, b = self.targets[which], self.sources[which]
        xi = ((poses[a].inverse() @ poses[b]).inverse() @ (self.now[a].inverse() @ self.now[b])).log()
        chi2: np.ndarray = np.einsum("ei,eij,ej->e", xi, self.information[which], xi)
        return np.sqrt(np.maximum(chi2, 0))


def _kept(pose: ScenePose, before: ScenePose, variance: float) -> ScenePose:
    covariance = pose.covariance
    if covariance is not None and before.covariance is not None:
        root = np.sqrt(np.maximum(np.diag(covariance), 0))
        if (np.abs(covariance - before.covariance) <= variance * root[:, None] * root[None]).all():
            covariance = before.covariance
    if covariance is before.covariance and (pose.component, pose.status) == (before.component, before.status):
        return before  # itself: who compares the two answers need not look at its numbers
    return replace(pose, S_map_scene=before.S_map_scene, covariance=covariance)


def _kept_outcome(outcome: EdgeOutcome, before: EdgeOutcome | None, variance: float) -> EdgeOutcome:
    if outcome is before:
        return outcome
    now, then = outcome.residual_chi2, None if before is None else before.residual_chi2
    if now is None or then is None or abs(now - then) > variance * (1 + then):
        return outcome
    return replace(outcome, residual_chi2=then)

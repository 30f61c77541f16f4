"""Keep previous poses where the new poses differ by less than their uncertainty."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmap.geometry.similarities import Similarities
from gsmap.optimize.params import Params
from gsmap.types import Edge, EdgeOutcome, PoseGraph, ScenePose, Sim3

_MAX_VARIANCE_CHANGE = 1e-2  # covariances and chi-squares that change by less (relative) are kept
_ROUNDING = 1e-9  # in rad, scene units and log scale: below the precision of any pose
_ROUNDS = 20  # number of times that scenes at the rim of a moved group are added to it; then the whole component moves
_SEAM = 10.0  # factor on the tolerance of edges at the rim of a moved group, where small steps add up


def keep_unchanged_poses(
    answer: PoseGraph, previous: PoseGraph | None, edges: Sequence[Edge], params: Params
) -> PoseGraph:
    """Return the answer, with the poses, covariances and chi-squares of the previous answer wherever both are
    equivalent.

    A scene keeps its pose if the new pose is within ``params.max_unchanged_sigmas`` standard deviations of the previous
    one, and if its relative pose to each neighbour is within as many standard deviations of their edge. Both tests are
    needed: far from the anchor, rounding may rotate all scenes together, which moves each by more than the uncertainty
    of its edges, but not relative to its neighbours. Scenes that moved are placed relative to unchanged scenes as in
    the answer.

    Every comparison uses an answer computed from all edges, so small steps do not add up.

    Args:
        previous: the previous answer; with None nothing is kept.
        edges: the edges of the answer; at least the edges of all scenes whose pose is not the same object as before,
            and of their neighbours.
        params: ``max_unchanged_sigmas`` is used.
    """
    if previous is None or not answer.poses:
        return answer
    used = [e for e in edges if answer.use(e.target, e.source) != "unused"]
    # Where new scenes were placed one by one, most pose objects are the previous ones.
    changed = {scene for scene, pose in answer.poses.items() if previous.poses.get(scene) is not pose}
    graph = _PosePairs.of(answer, previous, changed.union(*((e.target, e.source) for e in used)), used)
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
class _PosePairs:
    """N scenes by id with their new and previous poses, and the E edges in use between them.

    Args:
        known: (N,) mask of scenes with a previous pose; ``before`` has the new pose of the remaining scenes.
        targets, sources: (E,) rows of ``scenes``.
        information: (E, 7, 7) information matrices.
        component: (N,) component of each scene.
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
    def of(cls, answer: PoseGraph, previous: PoseGraph, among: Collection[str], edges: Sequence[Edge]) -> _PosePairs:
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
        """Return an (N,) mask of the scenes whose poses are unchanged."""
        steps = (self.before.inverse() @ self.now).log()
        covariances = [answer.poses[scene].covariance for scene in self.scenes]
        sigma = np.array([np.zeros(7) if c is None else np.sqrt(np.maximum(np.diag(c), 0)) for c in covariances])
        tied = np.zeros(len(self.scenes), dtype=bool)
        tied[self.targets] = tied[self.sources] = True
        # Scenes without covariance are compared with their neighbours only.
        free = tied & np.array([c is None for c in covariances], dtype=bool)
        still = self.known & (free | (np.abs(steps) <= _ROUNDING + sigmas * sigma).all(1))
        inside = still[self.targets] & still[self.sources]
        off = self._off(self.before, inside) > sigmas
        still[self.targets[inside][off]] = still[self.sources[inside][off]] = False
        return still

    def beside(self, still: np.ndarray, sigmas: float) -> dict[int, Sim3]:
        """Align each group of moved scenes with an unchanged scene beside it; return the aligned poses by row.

        If a gap to another unchanged scene remains, that scene moves as well, and ``still`` is updated.
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
        """Align the groups of moved scenes; return all poses, and the rows of the poses that are neither previous nor
        new."""
        ends, n = np.stack([self.targets, self.sources]), len(self.scenes)
        moved = ~still[ends].any(0)
        import scipy.sparse as sp  # imported here, as the recipe key does not need it
        from scipy.sparse.csgraph import connected_components

        tied = sp.coo_matrix((np.ones(moved.sum()), ends[:, moved]), shape=(n, n))
        group = connected_components(tied, directed=False)[1]
        seam = still[ends[0]] ^ still[ends[1]]
        stays = np.where(still[ends[0]], ends[0], ends[1])[seam]
        goes = np.where(still[ends[0]], ends[1], ends[0])[seam]
        contact = np.full(n, n)
        np.minimum.at(contact, group[goes], stays)  # the first scene by id, whatever the order of edges
        loose = np.flatnonzero(~still)
        poses = self.before.replaced(loose, self.now[loose])
        rows = loose[contact[group[loose]] < n]
        by = contact[group[rows]]
        back = self.before[by] @ self.now[by].inverse()
        return poses.replaced(rows, (back @ self.now[rows]).orthonormalised()), rows

    def _off(self, poses: Similarities, which: np.ndarray) -> np.ndarray:
        """Compute the (K,) distances of some edges from the answer's relative poses, in standard deviations."""
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
        return before  # the same object, so that comparing both answers is quick
    return replace(pose, S_map_scene=before.S_map_scene, covariance=covariance)


def _kept_outcome(outcome: EdgeOutcome, before: EdgeOutcome | None, variance: float) -> EdgeOutcome:
    if outcome is before:
        return outcome
    now, then = outcome.residual_chi2, None if before is None else before.residual_chi2
    if now is None or then is None or abs(now - then) > variance * (1 + then):
        return outcome
    return replace(outcome, residual_chi2=then)

"""Place new scenes in a solved map, by the edges of the new scenes and a solve of their neighbourhood."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gsmap.geometry.chi_square import chi2_quantile
from gsmap.geometry.similarities import Similarities
from gsmap.optimize.aliasing_evidence import find_doubtful
from gsmap.optimize.component_growth import accept_edges
from gsmap.optimize.contradictions import find_contested_edges, find_contradicting_edges
from gsmap.optimize.cycles import CycleSupport
from gsmap.optimize.fingerprint import fingerprint
from gsmap.optimize.measurements import Measurements, all_rigid, measurements
from gsmap.optimize.params import Params
from gsmap.optimize.priors import PriorTerms
from gsmap.optimize.recipe import recipe_key
from gsmap.optimize.report import pose_graph
from gsmap.optimize.robust import GaussNewton, chi_squares
from gsmap.optimize.state import State
from gsmap.optimize.structure import component_labels
from gsmap.types import Edge, EdgeOutcome, PoseGraph, Prior, ScenePose, Sim3
from gsmap.types.world import Survey

# Scenes within this many edges of a new scene's neighbours are solved; the outermost scenes stay fixed.
_NEIGHBOURHOOD_HOPS = 2


def place_new(
    scene_ids: Sequence[str],
    edges: Sequence[Edge],
    priors: Sequence[Prior],
    previous: PoseGraph,
    params: Params,
    survey: Survey,
) -> PoseGraph | None:
    """Place the new scenes in the previous answer; return None where only a full solve is correct.

    A full solve is due if scenes, measurements between old scenes or the recipe changed; if the map grew by
    ``params.max_growth`` since the last full solve; or if a new scene joins components, closes a long loop, is near
    duplicates or has edges that are doubtful or contradict each other. Poses placed here are provisional: only the
    neighbourhood of a new scene is solved with it.
    """
    new = _to_place(scene_ids, previous, params)
    if not new or not {*survey.scenes(), *(prior.scene for prior in priors)} <= set(previous.poses):
        return None
    fresh = set(new)
    old = [e for e in edges if e.target not in fresh and e.source not in fresh]
    if f"{fingerprint(old, priors, survey) % 2**64:016x}" != previous.provenance.measured:
        return None
    return _place_all(scene_ids, new, edges, previous, params)


def grow(scene_ids: Sequence[str], edges: Sequence[Edge], previous: PoseGraph, params: Params) -> PoseGraph | None:
    """Place new scenes like `place_new`, if all measurements between old scenes, priors and observations are unchanged.

    Args:
        edges: the edges between scenes of the `surroundings`; no further edges are needed.
    """
    new = _to_place(scene_ids, previous, params)
    return _place_all(scene_ids, new, edges, previous, params) if new else None


def surroundings(
    scene_ids: Sequence[str], pairs: Sequence[tuple[str, str]], previous: PoseGraph, params: Params
) -> tuple[set[str], set[str]]:
    """Return the scenes needed to place the new scenes, with two more rings of neighbours, and the outermost ring.

    All edges of scenes inside the outermost ring are between the returned scenes, so the result is exact if no scene of
    that ring moves (`keep_unchanged_poses` may move more scenes). Both sets are empty where only a full solve is
    correct.

    Args:
        pairs: (target, source) of all edges that may be used.
    """
    reached = set(_to_place(scene_ids, previous, params))
    connected = {pair for pair in pairs if not reached.isdisjoint(pair)}
    connected |= {pair for pair, outcome in previous.outcomes.items() if outcome.use != "unused"}
    beside: dict[str, list[str]] = {}
    for a, b in connected:
        beside.setdefault(a, []).append(b)
        beside.setdefault(b, []).append(a)
    ring = set(reached)
    for _ in range(1 + _NEIGHBOURHOOD_HOPS + 2):
        ring = {b for a in ring for b in beside.get(a, ())} - reached
        reached |= ring
    return reached, ring


def _to_place(scene_ids: Sequence[str], previous: PoseGraph, params: Params) -> list[str]:
    """Return the new scenes in the order of placing; empty if they may not be placed one by one."""
    known, provenance = previous.poses, previous.provenance
    new = [scene for scene in scene_ids if scene not in known]
    if provenance.recipe != recipe_key(params).recipe or not provenance.measured or params.max_growth <= 0:
        return []
    if len(known) + len(new) != len(scene_ids) or len(set(scene_ids)) != len(scene_ids):
        return []
    many = params.max_full_scenes < len(scene_ids) <= (1 + params.max_growth) * provenance.batch_scenes
    return new if many else []


def _place_all(
    scene_ids: Sequence[str], new: Sequence[str], edges: Sequence[Edge], previous: PoseGraph, params: Params
) -> PoseGraph | None:
    fresh = set(new)
    old = [e for e in edges if e.target not in fresh and e.source not in fresh]
    answer = previous
    taken = [e for e in old if previous.use(e.target, e.source) != "unused"]
    for scene in new:
        own = [
            e
            for e in edges
            if (e.target == scene and e.source in answer.poses) or (e.source == scene and e.target in answer.poses)
        ]
        placed = _place(scene, own, taken, answer, params)
        if placed is None:
            return None
        answer = placed
        taken += [e for e in own if answer.use(e.target, e.source) != "unused"]
    measured = int(previous.provenance.measured, 16)
    measured += fingerprint([e for e in edges if e.target in fresh or e.source in fresh])
    provenance = replace(previous.provenance, method="incremental", measured=f"{measured % 2**64:016x}")
    return replace(answer, poses={s: answer.poses[s] for s in scene_ids}, provenance=provenance)


def _place(scene: str, own: list[Edge], taken: list[Edge], previous: PoseGraph, params: Params) -> PoseGraph | None:
    near, rim, around = _surroundings(scene, own, taken, _NEIGHBOURHOOD_HOPS)
    m = measurements([*near, scene], around + own, rigid=all_rigid([*around, *own], (), previous))
    poses = Similarities.stack([previous.poses[s].S_map_scene for s in near] + [Sim3.identity()])
    accepted = np.r_[np.ones(len(around), dtype=bool), m.confirmed[len(around) :]]
    own_edges = m[np.arange(len(around), len(m))]
    if own_edges.confirmed.any() or m.duplicate.any() or find_doubtful(own_edges, params.max_look_alike).any():
        return None
    before = component_labels(m, np.flatnonzero(accepted))
    nothing = np.zeros(len(m), dtype=np.int64)
    state = State.fresh(m, poses, accepted, PriorTerms.stack((), ()))
    accept_edges(m, state, params)
    rows = np.flatnonzero(state.accepted)
    after = component_labels(m, rows)
    mine = np.flatnonzero(after == after[-1])[:-1]
    if len(np.unique(before[mine])) > 1:
        return None
    # If one edge connects a scene and another one contradicts it, only the whole map can decide.
    at_odds = np.union1d(
        find_contradicting_edges(m, state, params), np.flatnonzero(find_contested_edges(m, state, params))
    )
    if state.accepted[len(around) :].sum() < 2 and (at_odds >= len(around)).any():
        return None
    component = max((p.component for p in previous.poses.values()), default=-1) + 1
    fixed = np.ones(m.num_scenes, dtype=bool)
    covariances = np.zeros((m.num_scenes, 7, 7))
    components = np.array([previous.poses[s].component for s in near] + [component])
    if len(mine):
        # Joining moved the smaller component; the map keeps its frame.
        first = mine[:1]
        back = poses[first] @ state.poses[first].inverse()
        state.poses = state.poses.replaced(np.array([len(near)]), back @ state.poses[np.array([len(near)])])
        state.poses = state.poses.replaced(np.arange(len(near)), poses[: len(near)])
        fixed = np.r_[np.array([s in rim for s in near], dtype=bool), False] | (after != after[-1])
        if fixed[mine].all() or not fixed[mine].any():
            fixed[mine] = True
        descent = GaussNewton(m[rows], fixed)
        state.poses = descent.fit(state.poses, max_steps=5)
        components[-1] = components[first[0]]
        covariances[-1] = _covariance(len(near), rows, m, state.poses, [previous.poses[s] for s in near])
        gate = float(chi2_quantile(params.gate_probability, m.dim))
        bad = chi_squares(m, state.poses) > gate
        if (bad & state.accepted)[: len(around)].any():
            return None
    local = pose_graph(m, state.poses, components, covariances, state, CycleSupport.of(m, nothing), params)
    own_keys = {(e.target, e.source) for e in own}
    poses_now = dict(previous.poses)
    for k, s in enumerate(near):
        if not fixed[k] or local.poses[s].status == "placed":
            status = "placed" if "placed" in (local.poses[s].status, previous.poses[s].status) else "tentative"
            pose = previous.poses[s].S_map_scene if fixed[k] else local.poses[s].S_map_scene
            poses_now[s] = replace(previous.poses[s], S_map_scene=pose, status=status)
    poses_now[scene] = local.poses[scene]
    outcomes = dict(previous.outcomes)
    for key, outcome in local.outcomes.items():
        outcomes[key] = outcome if key in own_keys else _updated(previous.outcomes[key], outcome)
    notes = previous.notes
    if params.marginals and len(mine) and all(previous.poses[near[k]].covariance is None for k in mine.tolist()):
        notes += (f"the covariance of scene {scene} is relative to its neighbours, which have no covariance",)
    return replace(previous, poses=poses_now, outcomes=outcomes, notes=notes)


def _updated(old: EdgeOutcome, new: EdgeOutcome) -> EdgeOutcome:
    """Update an edge between old scenes after a scene was placed beside it: an unused edge may become used, never the
    reverse."""
    residual = old.residual_chi2 if new.residual_chi2 is None else new.residual_chi2
    return EdgeOutcome("used", residual) if new.use == "used" else replace(old, residual_chi2=residual)


def _surroundings(scene: str, own: list[Edge], taken: list[Edge], hops: int) -> tuple[list[str], set[str], list[Edge]]:
    """Return the scenes within ``hops`` edges of the new scene's neighbours, the outermost of these scenes, and the
    edges between them."""
    reached = {e.source if e.target == scene else e.target: 0 for e in own}
    for hop in range(1, hops + 1):
        ring = {b for e in taken for a, b in ((e.target, e.source), (e.source, e.target)) if reached.get(a) == hop - 1}
        for s in sorted(ring):
            reached.setdefault(s, hop)
    near = sorted(reached)
    around = [e for e in taken if e.target in reached and e.source in reached]
    return near, {s for s in near if reached[s] == hops}, around


def _covariance(scene: int, rows: np.ndarray, m: Measurements, poses: Similarities, old: list[ScenePose]) -> np.ndarray:
    """Estimate a provisional covariance: the best neighbour's covariance, propagated, plus the covariance of the new
    scene's edges."""
    dim = m.dim
    own = rows[(m.sources[rows] == scene) | (m.targets[rows] == scene)]
    information = np.zeros((dim, dim))
    for k in own.tolist():
        if m.sources[k] == scene:
            information += m.information[k]
        else:
            back = np.linalg.inv(m.measured[np.array([k])].adjoint()[0, :dim, :dim])
            information += back.T @ m.information[k] @ back
    out = np.zeros((7, 7))
    out[:dim, :dim] = np.linalg.inv(information)
    neighbours = np.where(m.sources[own] == scene, m.targets[own], m.sources[own])
    known = [(n, found) for n in neighbours.tolist() if (found := old[n].covariance) is not None]
    if known:
        best, covariance = min(known, key=lambda item: float(np.trace(item[1])))
        carry = (poses[np.array([scene])].inverse() @ poses[np.array([best])]).adjoint()[0]
        out += carry @ covariance @ carry.T
    return out

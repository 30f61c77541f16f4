"""The batch solve: all edges in, one honest map out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import networkx
import numpy as np
from scipy.stats import chi2

from gsmap.errors import ConfigError, InputError
from gsmap.geometry.similarities import Similarities
from gsmap.optimize import clean
from gsmap.optimize.components import Walk, allowed, closes, forest, grow, joins, merge_islands
from gsmap.optimize.cycles import Vote, vote
from gsmap.optimize.gauge import anchor_of, onto_anchor, onto_priors
from gsmap.optimize.measurements import Measurements, check_priors, measurements
from gsmap.optimize.priors import PriorTerms
from gsmap.optimize.robust import Descent, chi_squares, chordal, islands, roots, spread
from gsmap.types import Edge, PoseGraph, Prior, ScenePose, Sim3

MAX_ROUNDS = 30
# A person's edges contradict each other if one is off by more than this many gates after giving way to the others.
CONTRADICTION = 10.0


@dataclass(frozen=True)
class OptimizeParams:
    """How the map is solved.

    Args:
        gate_probability: an edge or cycle is consistent if its chi-square is below this quantile.
        anneal: width, in gates, at which the robust kernel starts.
        marginals: compute a covariance per scene.
        growth: with a previous answer, place new scenes one by one until the map has grown by this share since the
            last full solve; 0 always solves in full.
    """

    gate_probability: float = 0.999
    anneal: float = 16.0
    marginals: bool = True
    growth: float = 0.1

    def __post_init__(self) -> None:
        if not 0 < self.gate_probability < 1:
            raise ConfigError(f"gate_probability must lie between 0 and 1, got {self.gate_probability}")
        if not self.anneal >= 1:
            raise ConfigError(f"anneal must be at least 1, got {self.anneal}")
        if not self.growth >= 0:
            raise ConfigError(f"growth must not be negative, got {self.growth}")


@dataclass(eq=False)
class State:
    """What the solve believes at the moment: where scenes are, and which edges it takes in."""

    poses: Similarities
    accepted: np.ndarray
    failures: np.ndarray
    pending: dict[int, str]


def solve_batch(
    scene_ids: Sequence[str],
    edges: Sequence[Edge],
    priors: Sequence[Prior] = (),
    previous: PoseGraph | None = None,
    params: OptimizeParams = OptimizeParams(),
    progress: Callable[[float, str], None] | None = None,
) -> PoseGraph:
    """See `gsmap.optimize.optimize`."""
    report = progress or (lambda fraction, text: None)
    check_priors(scene_ids, priors)
    m = measurements(scene_ids, edges, rigid=_all_rigid(edges, priors, previous))
    terms = PriorTerms.stack(m.scene_ids, priors)
    gate = float(chi2.ppf(params.gate_probability, m.dim))

    report(0.05, "voting on cycles")
    votes = vote(m, params.gate_probability)
    state = _begin(m, votes, params)
    for turn in range(MAX_ROUNDS):
        report(0.1 + 0.6 * turn / MAX_ROUNDS, "growing components")
        _refine(m, terms, state, gate, params)
        if not (_close_loops(m, state, params) or _join(m, state, params)):
            break
    _refine(m, terms, state, gate, params)
    _check_confirmed(m, state, gate)

    report(0.75, "final solve")
    return _answer(m, terms, state, votes, previous, gate, params, report)


def _begin(m: Measurements, votes: Vote, params: OptimizeParams) -> State:
    """Spread poses along the best supported edges; keep the supported edges that agree with them."""
    accepted = (votes.agree > 0) | m.confirmed
    rows = np.flatnonzero(accepted)
    # A person's word first, then the number of agreeing triangles, then the more certain measurement.
    certainty = np.trace(m.covariance[rows], axis1=1, axis2=2)
    order = np.lexsort((certainty, -votes.agree[rows], ~m.confirmed[rows]))
    cost = np.empty(len(rows))
    cost[order] = np.arange(1, len(rows) + 1)
    poses = spread(m, rows, cost, Similarities.identity(m.num_scenes))
    if len(rows):
        accepted[rows] = closes(m, rows, Walk.over(m, rows, poses), params.gate_probability) | m.confirmed[rows]
    return State(poses, accepted, np.zeros(len(m), dtype=np.int64), {})


def _refine(m: Measurements, terms: PriorTerms, state: State, gate: float, params: OptimizeParams) -> None:
    """Robust poses of every island from its accepted edges; edges that do not fit are let go."""
    rows = np.flatnonzero(state.accepted)
    if not len(rows):
        return
    labels = islands(m, rows)
    held = np.isin(labels, np.unique(labels[terms.scenes]))
    anchors = roots(labels)
    fixed = np.zeros(m.num_scenes, dtype=bool)
    fixed[anchors] = True
    edges = m[rows]
    state.poses = chordal(edges, fixed, state.poses)
    for island in np.unique(labels[terms.scenes]):
        scenes = np.flatnonzero(labels == island)
        mine = terms[labels[terms.scenes] == island]
        state.poses = onto_priors(state.poses, scenes, int(scenes[0]), mine, m.dim)
    descent = Descent(edges, fixed & ~held, terms, anchors[held[anchors]])
    state.poses = descent.anneal(state.poses, gate, params.anneal, edges.confirmed)
    bad = (chi_squares(edges, state.poses) > gate) & ~edges.confirmed
    state.accepted[rows[bad]] = False
    state.failures[rows[bad]] += 1


def _close_loops(m: Measurements, state: State, params: OptimizeParams) -> bool:
    """Take in the edges inside an island that agree with what the island predicts for them."""
    rows = np.flatnonzero(~state.accepted & (state.failures < 2))
    if not len(rows):
        return False
    walk = Walk.over(m, np.flatnonzero(state.accepted), state.poses)
    fits = rows[closes(m, rows, walk, params.gate_probability)]
    state.accepted[fits] = True
    return len(fits) > 0


def _join(m: Measurements, state: State, params: OptimizeParams) -> bool:
    """Join islands: first where edges agree, and only when nothing agrees any more by single strong edges."""
    rows = np.flatnonzero(~state.accepted & (state.failures < 2))
    if not len(rows):
        return False
    walk = Walk.over(m, np.flatnonzero(state.accepted), state.poses)
    sizes = np.bincount(walk.labels)
    offers = joins(m, rows, walk, params.gate_probability)
    verdicts = [allowed(join, m, sizes) for join in offers]
    chosen = forest([j for j, v in zip(offers, verdicts, strict=True) if v == "agreed"], len(sizes))
    if not chosen:
        chosen = grow([j for j, v in zip(offers, verdicts, strict=True) if v == "single"], sizes)
    state.pending = {
        int(row): verdict
        for join, verdict in zip(offers, verdicts, strict=True)
        for row in join.offered
        if verdict not in ("agreed", "single")
    }
    if not chosen:
        return False
    taken, state.poses = merge_islands(m, chosen, walk.labels, state.poses)
    state.accepted[taken] = True
    return True


def _check_confirmed(m: Measurements, state: State, gate: float) -> None:
    """A person's edges are never voted out, so they must at least not contradict each other."""
    rows = np.flatnonzero(m.confirmed)
    if len(rows) < 2:
        return
    off = chi_squares(m[rows], state.poses) > CONTRADICTION * gate
    if not off.any():
        return
    # They may only be at odds with edges that nobody confirmed: ask them alone.
    alone = m[rows]
    labels = islands(alone, np.arange(len(rows)))
    fixed = np.zeros(m.num_scenes, dtype=bool)
    fixed[roots(labels)] = True
    none = PriorTerms.stack((), ())
    poses = Descent(alone, fixed, none).fit(chordal(alone, fixed, Similarities.identity(m.num_scenes)))
    worst = chi_squares(alone, poses)
    if worst.max() > CONTRADICTION * gate:
        target, source = alone.keys[int(np.argmax(worst))]
        raise InputError(
            f"confirmed edge {target}:{source} contradicts the other confirmed edges: reject it, or one of them"
        )


def _answer(
    m: Measurements,
    terms: PriorTerms,
    state: State,
    votes: Vote,
    previous: PoseGraph | None,
    gate: float,
    params: OptimizeParams,
    report: Callable[[float, str], None],
) -> PoseGraph:
    """Clean solve per component, then everything a person wants to know about scenes and edges."""
    rows = np.flatnonzero(state.accepted)
    labels = islands(m, rows)
    sizes = np.bincount(labels, minlength=1)
    covariances = np.zeros((m.num_scenes, 7, 7))
    poses = state.poses
    order = sorted(range(labels.max(initial=-1) + 1), key=lambda k: (-sizes[k], k))
    members = np.split(np.argsort(labels, kind="stable"), np.cumsum(sizes)[:-1]) if m.num_scenes else []
    edge_order = rows[np.argsort(labels[m.targets[rows]], kind="stable")]
    edge_members = np.split(edge_order, np.cumsum(np.bincount(labels[m.targets[rows]], minlength=len(sizes)))[:-1])
    prior_labels = labels[terms.scenes]
    component = np.zeros(m.num_scenes, dtype=np.int64)
    tied = set(prior_labels.tolist())
    for index, island in enumerate(order):
        report(0.75 + 0.25 * index / len(order), "final solve")
        scenes, mine = members[island], edge_members[island]
        priors = terms[prior_labels == island] if island in tied else terms[:0]
        anchor = anchor_of(scenes, m.scene_ids, previous)
        component[scenes] = index
        if len(priors):
            poses = onto_priors(poses, scenes, anchor, priors, m.dim)
        else:
            old = previous.poses.get(m.scene_ids[anchor]) if previous else None
            poses = onto_anchor(poses, scenes, anchor, old.S_map_scene if old else Sim3.identity())
        if len(mine) or len(priors):
            poses, found = clean.solve(m[mine], poses, anchor, priors, marginals=params.marginals)
            if found is not None:
                covariances[scenes] = found[scenes]
    return _describe(m, poses, component, covariances, state, votes, gate, params)


def _describe(
    m: Measurements,
    poses: Similarities,
    component: np.ndarray,
    covariances: np.ndarray,
    state: State,
    votes: Vote,
    gate: float,
    params: OptimizeParams,
) -> PoseGraph:
    chi = chi_squares(m, poses)
    together = component[m.targets] == component[m.sources]
    bridges = _bridges(m, state.accepted)
    firm = state.accepted & (~bridges | m.confirmed)
    status = np.full(m.num_scenes, "isolated", dtype=object)
    for rows, name in ((np.flatnonzero(state.accepted), "tentative"), (np.flatnonzero(firm), "placed")):
        status[m.targets[rows]] = status[m.sources[rows]] = name

    used: dict[tuple[str, str], bool | str] = {}
    residual: dict[tuple[str, str], float] = {}
    reasons: dict[tuple[str, str], str] = {}
    undecided = []
    for k, key in enumerate(m.keys):
        used[key] = True if firm[k] else "tentative" if state.accepted[k] else False
        if together[k]:
            residual[key] = float(chi[k])
        if firm[k]:
            continue
        if state.accepted[k]:
            reasons[key] = "in no agreeing cycle: rests on its own verdict alone"
        elif not together[k]:
            reasons[key] = state.pending.get(k, "ties two islands that nothing else joins")
            undecided.append(key)
        else:
            reasons[key] = f"contradicts the other edges: chi-square {chi[k]:.0f}, limit {gate:.0f}"
            doubtful = status[m.targets[k]] == "tentative" or status[m.sources[k]] == "tentative"
            if votes.agree[k] > 0:
                reasons[key] += "; it agrees with others that do too (a place that looks alike?)"
            if votes.agree[k] > 0 or doubtful:
                undecided.append(key)
    return PoseGraph(
        poses={
            scene: ScenePose(
                scene,
                poses.item(k),
                int(component[k]),
                str(status[k]),
                covariances[k] if params.marginals and status[k] != "isolated" else None,
            )
            for k, scene in enumerate(m.scene_ids)
        },
        used=used,
        residuals=residual,
        reasons=reasons,
        undecided=tuple(undecided),
        parameters={**asdict(params), "method": "batch", "batch_scenes": m.num_scenes},
    )


def _bridges(m: Measurements, accepted: np.ndarray) -> np.ndarray:
    """(E,) bool: accepted edges on no cycle of accepted edges."""
    rows = np.flatnonzero(accepted)
    low, high = np.minimum(m.targets[rows], m.sources[rows]), np.maximum(m.targets[rows], m.sources[rows])
    pairs, which, count = np.unique(low * m.num_scenes + high, return_inverse=True, return_counts=True)
    graph = networkx.Graph(zip((pairs // m.num_scenes).tolist(), (pairs % m.num_scenes).tolist(), strict=True))
    found = np.array([a * m.num_scenes + b for edge in networkx.bridges(graph) for a, b in (sorted(edge),)])
    out = np.zeros(len(m), dtype=bool)
    out[rows] = np.isin(pairs[which], found) & (count[which] == 1)
    return out


def _all_rigid(edges: Sequence[Edge], priors: Sequence[Prior], previous: PoseGraph | None) -> bool:
    """Whether scale can be left out: nothing has one, so six dimensions suffice."""
    return (
        all(e.S_target_source.is_rigid for e in edges)
        and all(p.S_map_scene.is_rigid for p in priors)
        and (previous is None or all(p.S_map_scene.is_rigid for p in previous.poses.values()))
    )

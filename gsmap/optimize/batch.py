"""The batch solve: all edges in, one honest map out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import networkx
import numpy as np
from scipy.stats import chi2

from gsmap.errors import ConfigError, InputError
from gsmap.geometry.similarities import Similarities
from gsmap.optimize import clean
from gsmap.optimize.components import (
    SMALL_ISLAND,
    Walk,
    allowed,
    bridges,
    closes,
    forest,
    grow,
    joins,
    merge_islands,
)
from gsmap.optimize.conflicts import contradicted_priors, undecided_groups
from gsmap.optimize.cycles import Vote, vote
from gsmap.optimize.gauge import anchor_of, onto_anchor, onto_priors
from gsmap.optimize.measurements import Measurements, check_priors, measurements
from gsmap.optimize.priors import PriorTerms
from gsmap.optimize.robust import Descent, chi_squares, chordal, islands, roots, spread
from gsmap.types import Edge, EdgeOutcome, PoseGraph, Prior, Provenance, ScenePose, Sim3
from gsmap.types.plain import plain

MAX_ROUNDS = 30
# A person's edges contradict each other if one is off by more than this many gates after giving way to the others.
CONTRADICTION = 10.0
# Poses from which an accepted edge is off by more gates than this are no start for Gauss-Newton.
DRIFTED = 4.0


@dataclass(frozen=True)
class OptimizeParams:
    """How the map is solved.

    Args:
        gate_probability: an edge or cycle is consistent if its chi-square is below this quantile.
        anneal: width, in gates, at which the robust kernel starts.
        marginals: compute a covariance per scene, in components of up to 3000 scenes.
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
    undecided: np.ndarray
    rejected: np.ndarray
    terms: PriorTerms
    pending: dict[int, str]

    @classmethod
    def fresh(cls, m: Measurements, poses: Similarities, accepted: np.ndarray, terms: PriorTerms) -> State:
        no = np.zeros(len(m), dtype=bool)
        return cls(poses, accepted, np.zeros(len(m), dtype=np.int64), no, no, terms, {})

    @property
    def open(self) -> np.ndarray:
        """Rows of the edges that may still be taken in."""
        return np.flatnonzero(~self.accepted & ~self.undecided & ~self.rejected & (self.failures < 2))


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
    gate = float(chi2.ppf(params.gate_probability, m.dim))

    report(0.05, "voting on cycles")
    votes = vote(m, params.gate_probability)
    state = _begin(m, votes, PriorTerms.stack(m.scene_ids, priors), params)
    _refine(m, state, gate, params.anneal)
    for turn in range(MAX_ROUNDS):
        report(0.1 + 0.6 * turn / MAX_ROUNDS, "growing components")
        if _take_in_agreeing(m, state, params):
            _cut_weak_bridges(m, state)
            _refine(m, state, gate, 1.0)
        elif _close_through_singles(m, state, params):
            _refine(m, state, gate, 1.0)
        elif not _part_lookalikes(m, votes, state, gate, params):
            break
    while _join(m, state, params, single=True):
        pass
    _forgive(m, state, gate)
    _check_confirmed(m, state, gate)

    report(0.75, "final solve")
    return _answer(m, state, votes, priors, previous, params, report)


def _begin(m: Measurements, votes: Vote, terms: PriorTerms, params: OptimizeParams) -> State:
    """Spread poses along the best supported edges; keep the supported edges that agree with them."""
    accepted = (votes.agree > 0) | m.confirmed
    rows = np.flatnonzero(accepted)
    # A person's word first, then what its neighbours support, then the more certain measurement.
    certainty = np.trace(m.covariance[rows], axis1=1, axis2=2)
    order = np.lexsort((certainty, -votes.support[rows], ~m.confirmed[rows]))
    cost = np.empty(len(rows))
    cost[order] = np.arange(1, len(rows) + 1)
    poses = spread(m, rows, cost, Similarities.identity(m.num_scenes))
    if len(rows):
        accepted[rows] = closes(m, rows, Walk.over(m, rows, poses), params.gate_probability) | m.confirmed[rows]
    return State.fresh(m, poses, accepted, terms)


def _refine(m: Measurements, state: State, gate: float, widest: float) -> None:
    """Robust poses of every island from its accepted edges; edges that do not fit are let go."""
    rows = np.flatnonzero(state.accepted)
    if not len(rows):
        return
    labels = islands(m, rows)
    fixed = np.zeros(m.num_scenes, dtype=bool)
    fixed[roots(labels)] = True
    edges = m[rows]
    if (chi_squares(edges, state.poses) > DRIFTED * gate).any():
        state.poses = chordal(edges, fixed, state.poses)
    state.poses = Descent(edges, fixed).anneal(state.poses, gate, widest, edges.confirmed)
    bad = (chi_squares(edges, state.poses) > gate) & ~edges.confirmed
    state.accepted[rows[bad]] = False
    state.failures[rows[bad]] += 1


def _take_in_agreeing(m: Measurements, state: State, params: OptimizeParams) -> bool:
    """Take in edges and join islands as long as edges agree; poses are moved, not yet refined."""
    any_taken = False
    while _close_loops(m, state, params) or _join(m, state, params, single=False):
        any_taken = True
    return any_taken


def take_in(m: Measurements, state: State, params: OptimizeParams) -> None:
    """Take in what agrees, and then what single edges attach."""
    while _take_in_agreeing(m, state, params) or _join(m, state, params, single=True):
        pass


def _close_through_singles(m: Measurements, state: State, params: OptimizeParams) -> bool:
    """Take in the cycles that close once single edges attach small islands.

    The single edges that no cycle bears out are let go again, for a scene that rests on one edge must not vouch for
    others; they come back when nothing else does.
    """
    accepted, poses = state.accepted.copy(), state.poses
    while _join(m, state, params, single=True):
        _close_loops(m, state, params)
    state.accepted &= accepted | m.confirmed | ~bridges(m, state.accepted)
    if (state.accepted & ~accepted).any():
        return True
    state.poses = poses
    return False


def _close_loops(m: Measurements, state: State, params: OptimizeParams) -> bool:
    """Take in the edges inside an island that agree with what the island predicts for them."""
    rows = state.open
    if not len(rows):
        return False
    walk = Walk.over(m, np.flatnonzero(state.accepted), state.poses)
    fits = rows[closes(m, rows, walk, params.gate_probability)]
    state.accepted[fits] = True
    return len(fits) > 0


def _join(m: Measurements, state: State, params: OptimizeParams, *, single: bool) -> bool:
    """Join islands where edges agree, or, with ``single``, where one edge attaches a small island."""
    rows = state.open
    if not len(rows):
        return False
    walk = Walk.over(m, np.flatnonzero(state.accepted), state.poses)
    sizes = np.bincount(walk.labels)
    offers = joins(m, rows, walk, params.gate_probability)
    verdicts = [allowed(join, m, sizes) for join in offers]
    wanted = "single" if single else "agreed"
    fitting = [join for join, verdict in zip(offers, verdicts, strict=True) if verdict == wanted]
    chosen = grow(fitting, sizes) if single else forest(fitting, len(sizes))
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


def _part_lookalikes(m: Measurements, votes: Vote, state: State, gate: float, params: OptimizeParams) -> bool:
    """Part islands where a group of edges contradicts them and is not clearly outweighed."""
    settled = state.undecided | state.rejected
    wrong, right, unclear = undecided_groups(m, state.accepted, settled, state.poses, votes, params.gate_probability)
    if len(state.terms):
        elsewhere, outweighed = contradicted_priors(m, state.accepted, state.poses, votes, state.terms)
        wrong |= elsewhere
        state.terms = state.terms[np.flatnonzero(~outweighed)]
    if not (wrong | unclear).any():
        return False
    state.accepted &= ~(wrong | unclear)
    state.undecided |= unclear
    state.rejected |= wrong
    state.failures[right] = 0
    _refine(m, state, gate, 1.0)
    return True


def _cut_weak_bridges(m: Measurements, state: State) -> None:
    """Let go of single edges that have come to hold two firm islands together.

    A scene attached by one edge may turn out to belong to an island of its own; then that edge alone would join two
    islands, which it may not.
    """
    single = bridges(m, state.accepted) & ~m.confirmed
    blocks = islands(m, np.flatnonzero(state.accepted & ~single))
    solid = np.bincount(blocks) >= SMALL_ISLAND
    graph = networkx.Graph()
    rows = np.flatnonzero(single)
    ends = np.stack([blocks[m.targets[rows]], blocks[m.sources[rows]]], axis=1)
    graph.add_edges_from((a, b, {"row": row}) for (a, b), row in zip(ends.tolist(), rows.tolist(), strict=True))
    for part in networkx.connected_components(graph):
        tree = graph.subgraph(part)
        total = sum(solid[k] for k in part)
        if total < 2:
            continue
        below = {k: int(solid[k]) for k in part}
        for child, parent in reversed([(b, a) for a, b in networkx.bfs_edges(tree, min(part))]):
            if 0 < below[child] < total:
                state.accepted[tree.edges[child, parent]["row"]] = False
            below[parent] += below[child]


def _forgive(m: Measurements, state: State, gate: float) -> None:
    """Take back edges that failed on the way and fit now."""
    labels = islands(m, np.flatnonzero(state.accepted))
    inside = labels[m.targets] == labels[m.sources]
    state.accepted |= inside & ~state.undecided & ~state.rejected & (chi_squares(m, state.poses) < gate)


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
    poses = Descent(alone, fixed).fit(chordal(alone, fixed, Similarities.identity(m.num_scenes)))
    worst = chi_squares(alone, poses)
    if worst.max() > CONTRADICTION * gate:
        target, source = alone.keys[int(np.argmax(worst))]
        raise InputError(
            f"confirmed edge {target}:{source} contradicts the other confirmed edges: reject it, or one of them"
        )


def _answer(
    m: Measurements,
    state: State,
    votes: Vote,
    priors: Sequence[Prior],
    previous: PoseGraph | None,
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
    terms = state.terms
    prior_labels = labels[terms.scenes]
    component = np.zeros(m.num_scenes, dtype=np.int64)
    tied = set(prior_labels.tolist())
    world: int | None = None
    for index, island in enumerate(order):
        report(0.75 + 0.25 * index / len(order), "final solve")
        scenes, mine = members[island], edge_members[island]
        own = terms[np.flatnonzero(prior_labels == island)] if island in tied else terms[:0]
        anchor = anchor_of(scenes, m.scene_ids, previous)
        component[scenes] = index
        old = previous.poses.get(m.scene_ids[anchor]) if previous else None
        poses = onto_anchor(poses, scenes, anchor, old.S_map_scene if old else Sim3.identity())
        if len(own):
            poses = onto_priors(poses, scenes, anchor, own, m.dim)
            if not len(clean.open_gauge(poses, scenes, anchor, own, m.dim)):
                # Fully known to the outside: it shares the world's frame with every other such island.
                component[scenes] = world = index if world is None else world
        if len(mine) or len(own):
            poses, found = clean.solve(m[mine], poses, anchor, own, marginals=params.marginals)
            if found is not None:
                covariances[scenes] = found[scenes]
    _, component = np.unique(component, return_inverse=True)
    answer = answer_of(m, poses, component, covariances, state, votes, params)
    known = {m.scene_ids[k] for k in terms.scenes.tolist()}
    dropped = tuple(p.scene for p in priors if p.scene not in known)
    return replace(answer, provenance=replace(answer.provenance, contradicted_priors=dropped))


def answer_of(
    m: Measurements,
    poses: Similarities,
    component: np.ndarray,
    covariances: np.ndarray,
    state: State,
    votes: Vote,
    params: OptimizeParams,
) -> PoseGraph:
    """Everything a person wants to know about scenes and edges, in words and by id."""
    gate = float(chi2.ppf(params.gate_probability, m.dim))
    chi = chi_squares(m, poses)
    together = component[m.targets] == component[m.sources]
    single = bridges(m, state.accepted)
    firm = state.accepted & (~single | m.confirmed)
    status = _statuses(m, state.accepted, firm)

    outcomes: dict[tuple[str, str], EdgeOutcome] = {}
    for k, key in enumerate(m.keys):
        residual = float(chi[k]) if together[k] else None
        if firm[k]:
            outcomes[key] = EdgeOutcome("used", residual)
        elif state.accepted[k]:
            reason = "in no agreeing cycle: rests on its own verdict alone"
            outcomes[key] = EdgeOutcome("tentative", residual, reason)
        elif not together[k]:
            open_question = "edges that agree among themselves contradict each other here: places that look alike?"
            reason = (
                open_question
                if state.undecided[k]
                else state.pending.get(k, "contradicts what else is known of the two components")
            )
            outcomes[key] = EdgeOutcome("unused", None, reason, undecided=True)
        else:
            reason = f"contradicts the other edges: chi-square {chi[k]:.0f}, limit {gate:.0f}"
            doubtful = status[m.targets[k]] == "tentative" or status[m.sources[k]] == "tentative"
            if votes.agree[k] > 0:
                reason += "; it agrees with others that do too (a place that looks alike?)"
            undecided = bool(votes.agree[k] > 0 or doubtful or state.undecided[k] or state.rejected[k])
            outcomes[key] = EdgeOutcome("unused", residual, reason, undecided)
    return PoseGraph(
        poses={
            scene: ScenePose(
                scene,
                poses.item(k),
                int(component[k]),
                str(status[k]),
                covariances[k] if covariances[k].any() else None,
            )
            for k, scene in enumerate(m.scene_ids)
        },
        outcomes=outcomes,
        settings=plain(params),
        provenance=Provenance("batch", batch_scenes=m.num_scenes),
    )


def _statuses(m: Measurements, accepted: np.ndarray, firm: np.ndarray) -> np.ndarray:
    """(N,) ``placed`` in the largest firmly tied part of an island, ``tentative`` beside it, ``isolated`` alone."""
    component = islands(m, np.flatnonzero(accepted))
    blocks = islands(m, np.flatnonzero(firm))
    sizes = np.bincount(blocks, minlength=1)[blocks]
    order = np.lexsort((blocks, -sizes, component))
    _, first, which = np.unique(component[order], return_index=True, return_inverse=True)
    main = np.empty(m.num_scenes, dtype=bool)
    main[order] = blocks[order] == blocks[order[first]][which]
    status = np.where(main & (sizes > 1), "placed", "tentative").astype(object)
    tied = np.zeros(m.num_scenes, dtype=bool)
    rows = np.flatnonzero(accepted)
    tied[m.targets[rows]] = tied[m.sources[rows]] = True
    status[~tied] = "isolated"
    return status


def _all_rigid(edges: Sequence[Edge], priors: Sequence[Prior], previous: PoseGraph | None) -> bool:
    """Whether scale can be left out: nothing has one, so six dimensions suffice."""
    return (
        all(e.S_target_source.is_rigid for e in edges)
        and all(p.S_map_scene.is_rigid for p in priors)
        and (previous is None or all(p.S_map_scene.is_rigid for p in previous.poses.values()))
    )

"""Grow components by loop closures, joins and single edges, and cut weak bridges."""

from __future__ import annotations

import networkx
import numpy as np

from gsmap.optimize.component_joins import attaching_joins, find_joins, join_decision, merge_components, spanning_joins
from gsmap.optimize.consistency import consistent_with_component
from gsmap.optimize.measurements import Measurements
from gsmap.optimize.params import Params
from gsmap.optimize.state import State
from gsmap.optimize.structure import bridges, component_labels


def accept_agreeing_edges(m: Measurements, state: State, params: Params) -> bool:
    """Accept edges and join components as long as edges agree; poses are moved but not yet refined. Return whether any
    changed."""
    any_taken = False
    while close_loops(m, state, params) or join_components(m, state, params, single=False):
        any_taken = True
    return any_taken


def accept_edges(m: Measurements, state: State, params: Params) -> None:
    """Accept agreeing edges, then attach small components by single edges."""
    while accept_agreeing_edges(m, state, params) or join_components(m, state, params, single=True):
        pass


def attach_by_single_edges(m: Measurements, state: State, params: Params) -> None:
    """Attach small components by single edges until none can be attached."""
    while join_components(m, state, params, single=True):
        pass


def close_loops_through_single_edges(m: Measurements, state: State, params: Params) -> bool:
    """Accept the cycles that close once small components are attached by single edges.

    Single edges that no cycle confirms are excluded again, because a scene with one edge is no evidence for other
    edges; they are accepted again at the end.
    """
    accepted, poses = state.accepted.copy(), state.poses
    while join_components(m, state, params, single=True):
        close_loops(m, state, params)
    state.accepted &= accepted | m.confirmed | ~bridges(m, state.accepted)
    if (state.accepted & ~accepted).any():
        return True
    state.poses = poses
    return False


def close_loops(m: Measurements, state: State, params: Params) -> bool:
    """Accept the edges inside a component that agree with the component's prediction."""
    rows = state.open()
    if not len(rows):
        return False
    drift = state.drift(m)
    fits = rows[consistent_with_component(m, rows, drift, params.gate_probability)]
    state.accepted[fits] = True
    return len(fits) > 0


def join_components(m: Measurements, state: State, params: Params, *, single: bool) -> bool:
    """Join components where several edges agree or, with ``single``, where one edge attaches a small component."""
    rows = state.open()
    if not len(rows):
        return False
    drift = state.drift(m)
    sizes = np.bincount(drift.labels)
    offers = find_joins(m, rows, drift, params.gate_probability)
    decisions = [join_decision(join, m, sizes, params) for join in offers]
    wanted = "single" if single else "agreed"
    fitting = [join for join, decision in zip(offers, decisions, strict=True) if decision == wanted]
    if single:
        chosen = attaching_joins(fitting, sizes, params.min_large_component)
    else:
        chosen = spanning_joins(fitting, len(sizes))
    state.pending = {
        int(row): decision
        for join, decision in zip(offers, decisions, strict=True)
        for row in join.offered
        if decision not in ("agreed", "single")
    }
    if not chosen:
        return False
    taken, state.poses = merge_components(m, chosen, drift.labels, state.poses)
    state.accepted[taken] = True
    return True


def cut_weak_bridges(m: Measurements, state: State, params: Params) -> None:
    """Exclude single edges that by now connect two large components.

    A scene attached by one edge may become part of a large component; then that edge alone would join two large
    components, which is not allowed.
    """
    single = bridges(m, state.accepted) & ~m.confirmed
    blocks = component_labels(m, np.flatnonzero(state.accepted & ~single))
    solid = np.bincount(blocks) >= params.min_large_component
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

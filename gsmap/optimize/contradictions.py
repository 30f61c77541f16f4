"""Loops that one edge does not close: which of their edges is wrong, by the likelihood of what registration saw.

An edge inside a component that contradicts it makes a loop with the accepted edges between its ends, and one edge of
that loop is wrong. Edges on agreeing cycles are borne out; suspects are the edge itself and the accepted edges that
rest on their own verdict alone. The order in which edges came decides nothing: the least likely suspect is let go where
it is surely the wrong one, and where the evidence cannot separate them none of them is used.

Assumption: exactly one edge of a loop is wrong, and the suspects' evidence is independent. Where no likelihood is known
(edges that nobody registered, scenes without cameras), what is in the map stays, tentative.
"""

from __future__ import annotations

import itertools

import networkx
import numpy as np

from gsmap.optimize.consistency import consistent_with_component
from gsmap.optimize.joining import find_joins
from gsmap.optimize.measurements import Measurements
from gsmap.optimize.params import Params
from gsmap.optimize.state import State
from gsmap.optimize.structure import bridges, component_labels

CONTRADICTION_GATES = 10.0  # chi-square, in gates, beyond which an edge contradicts the edges that it makes a loop with
MAX_SUSPECTS = 4  # if more may be wrong, none is excluded: the wrong one is not likely among them


def part_contradicted(m: Measurements, state: State, params: Params) -> bool:
    """Let go of the edges of contradictory loops that are, or may be, wrong; poses are left as they are.

    Returns:
        Whether accepted edges were let go. Then others may join what has come apart, and loops that lost an edge are
        not decided yet.
    """
    rows = contradicting(m, state, params)
    if not len(rows):
        return False
    single = bridges(m, state.accepted)
    blocks = component_labels(m, np.flatnonzero(state.accepted & ~single))
    between = networkx.Graph()
    for row in np.flatnonzero(single).tolist():
        between.add_edge(blocks[m.targets[row]], blocks[m.sources[row]], row=row)
    any_let_go = False
    for row in rows[np.argsort(m.log_odds_wrong[rows], kind="stable")].tolist():
        ends = blocks[m.targets[row]], blocks[m.sources[row]]
        if ends[0] == ends[1]:
            continue
        way = networkx.shortest_path(between, *ends)
        loop = np.array([between.edges[pair]["row"] for pair in itertools.pairwise(way)])
        is_open = state.accepted[loop].all()
        loop = loop[~m.confirmed[loop] & np.isfinite(m.log_odds_wrong[loop])]
        any_let_go |= bool(is_open and len(loop) and _let_go(m, state, row, loop, params))
    return any_let_go


def contradicting(m: Measurements, state: State, params: Params) -> np.ndarray:
    """Rows of the edges of known likelihood that are in no doubt and contradict the component they lie in."""
    settled = state.accepted | state.undecided | state.rejected | state.doubtful
    labels = component_labels(m, np.flatnonzero(state.accepted))
    inside = labels[m.targets] == labels[m.sources]
    rows = np.flatnonzero(inside & ~settled & np.isfinite(m.log_odds_wrong))
    if not len(rows):
        return rows
    drift, probability = state.drift(m), params.gate_probability
    return rows[~consistent_with_component(m, rows, drift, probability, CONTRADICTION_GATES)]


def contested(m: Measurements, state: State, params: Params) -> np.ndarray:
    """(E,) bool: edges of known likelihood that would tie two components, and contradict others that would as well."""
    out = np.zeros(len(m), dtype=bool)
    rows = state.open()
    rows = rows[np.isfinite(m.log_odds_wrong[rows])]
    if len(rows):
        for join in find_joins(m, rows, state.drift(m), params.gate_probability):
            out[join.offered] = join.rival > 0
    return out


def _let_go(m: Measurements, state: State, row: int, loop: np.ndarray, params: Params) -> bool:
    """Decide between an edge and the accepted edges that it contradicts; whether any of these was let go."""
    suspects = np.r_[row, loop]
    probability = np.exp(m.log_odds_wrong[suspects] - m.log_odds_wrong[suspects].max())
    probability /= probability.sum()
    order = np.argsort(-probability, kind="stable")
    # The fewest that surely hold the wrong one. Where those are many, parting all would lose what is known.
    count = 1 + int(np.searchsorted(probability[order].cumsum(), params.min_wrong_probability - 1e-9))
    found = suspects[order[: count if count <= MAX_SUSPECTS else 1]]
    if count == 1:
        state.rejected[found] = found != row  # the map stands where it is the contradicting edge
    else:
        state.ambiguous[found] = state.undecided[found] = True
    let_go = bool(state.accepted[found].any())
    state.accepted[found] = False
    return let_go

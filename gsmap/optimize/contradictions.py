"""Decide which edge of a contradictory loop is wrong, by the likelihood of the registrations.

An edge that contradicts its own component forms a loop with the accepted edges between its two scenes, and one edge of
that loop is wrong. Edges on agreeing cycles are not suspect; suspects are the contradicting edge and the accepted edges
without an agreeing cycle. The least likely suspect is excluded if it is probably the wrong one, whatever the order of
the edges. If the evidence cannot separate the suspects, none of them is used.

Assumption: exactly one edge of a loop is wrong, and the evidence of the suspects is independent. Where no likelihood is
known (edges added by a person, scenes without cameras), accepted edges remain accepted, but tentative.
"""

from __future__ import annotations

import itertools

import networkx
import numpy as np

from gsmap.optimize.component_joins import find_joins
from gsmap.optimize.consistency import consistent_with_component
from gsmap.optimize.measurements import Measurements
from gsmap.optimize.params import Params
from gsmap.optimize.state import State
from gsmap.optimize.structure import bridges, component_labels

CONTRADICTION_GATES = 10.0  # an edge whose chi-square exceeds this many gates contradicts the edges of its loop
MAX_SUSPECTS = 4  # with more suspects none is excluded


def exclude_contradicted(m: Measurements, state: State, params: Params) -> bool:
    """Exclude edges of contradictory loops that are wrong or may be wrong; poses stay as they are.

    Returns:
        True if accepted edges were excluded. Then other edges may join the separated parts, and loops that lost an edge
        are still undecided.
    """
    rows = find_contradicting_edges(m, state, params)
    if not len(rows):
        return False
    single = bridges(m, state.accepted)
    blocks = component_labels(m, np.flatnonzero(state.accepted & ~single))
    between = networkx.Graph()
    for row in np.flatnonzero(single).tolist():
        between.add_edge(blocks[m.targets[row]], blocks[m.sources[row]], row=row)
    any_excluded = False
    for row in rows[np.argsort(m.log_odds_wrong[rows], kind="stable")].tolist():
        ends = blocks[m.targets[row]], blocks[m.sources[row]]
        if ends[0] == ends[1]:
            continue
        way = networkx.shortest_path(between, *ends)
        loop = np.array([between.edges[pair]["row"] for pair in itertools.pairwise(way)])
        is_open = state.accepted[loop].all()
        loop = loop[~m.confirmed[loop] & np.isfinite(m.log_odds_wrong[loop])]
        any_excluded |= bool(is_open and len(loop) and _exclude_suspects(m, state, row, loop, params))
    return any_excluded


def find_contradicting_edges(m: Measurements, state: State, params: Params) -> np.ndarray:
    """Return the rows of undoubted edges of known likelihood that contradict their own component."""
    settled = state.accepted | state.undecided | state.rejected | state.doubtful
    labels = component_labels(m, np.flatnonzero(state.accepted))
    inside = labels[m.targets] == labels[m.sources]
    rows = np.flatnonzero(inside & ~settled & np.isfinite(m.log_odds_wrong))
    if not len(rows):
        return rows
    drift, probability = state.drift(m), params.gate_probability
    return rows[~consistent_with_component(m, rows, drift, probability, CONTRADICTION_GATES)]


def find_contested_edges(m: Measurements, state: State, params: Params) -> np.ndarray:
    """Return an (E,) mask of the edges of known likelihood that would join two components and contradict other such
    edges."""
    out = np.zeros(len(m), dtype=bool)
    rows = state.open()
    rows = rows[np.isfinite(m.log_odds_wrong[rows])]
    if len(rows):
        for join in find_joins(m, rows, state.drift(m), params.gate_probability):
            out[join.offered] = join.rival > 0
    return out


def _exclude_suspects(m: Measurements, state: State, row: int, loop: np.ndarray, params: Params) -> bool:
    """Decide between an edge and the accepted edges that it contradicts; return True if any accepted edge was
    excluded."""
    suspects = np.r_[row, loop]
    probability = np.exp(m.log_odds_wrong[suspects] - m.log_odds_wrong[suspects].max())
    probability /= probability.sum()
    order = np.argsort(-probability, kind="stable")
    # The fewest suspects that probably include the wrong edge. If there are many, excluding all would lose correct
    # edges.
    count = 1 + int(np.searchsorted(probability[order].cumsum(), params.min_wrong_probability - 1e-9))
    found = suspects[order[: count if count <= MAX_SUSPECTS else 1]]
    if count == 1:
        state.rejected[found] = found != row  # if the contradicting edge is wrong, the map stays as it is
    else:
        state.ambiguous[found] = state.undecided[found] = True
    excluded = bool(state.accepted[found].any())
    state.accepted[found] = False
    return excluded

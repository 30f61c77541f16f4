"""Edges whose captures disagree in what both saw: of one place that changed, or of two places that look alike.

No pair by itself can tell which. The map can: what the other edges bear out is one place that changed; what they
contradict is not. An edge that ties parts of the map which nothing else ties is held for a place that changed as long
as this map's doubtful edges mostly turned out so, and its scenes are tentative; where they mostly turned out to be of
other places, the parts stay apart.

Assumption: of one place captured twice without change nearly all of what both saw agrees, so edges without doubt are
right as often as any. It fails where rooms are repeated entirely, their furniture included; see
`gsmap.optimize.perceptual_aliasing` for what is left then.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmap.optimize.growing import close_loops, take_in
from gsmap.optimize.measurements import Measurements
from gsmap.optimize.params import Aliasing, Params
from gsmap.optimize.state import State, refine
from gsmap.optimize.structure import component_labels


def find_doubtful(m: Measurements, params: Aliasing) -> np.ndarray:
    """(E,) bool: more of what both scenes saw disagrees than in one place captured twice without change."""
    with np.errstate(invalid="ignore"):  # nobody looked: no doubt
        found: np.ndarray = (m.disagreement > params.max_disagreement) & ~m.confirmed
    return found


def take_in_doubtful(m: Measurements, state: State, doubtful: np.ndarray, gate: float, params: Params) -> None:
    """Take in the doubtful edges that the map bears out, and by the others what nothing else ties, if this map's
    record allows it."""
    most = params.aliasing.max_chance_alike
    if close_loops(m, state, params):
        refine(m, state, gate, 1.0, params)
    inside = doubtful & _within(m, state.accepted)
    borne_out = int((inside & state.accepted).sum())
    tying = doubtful & ~inside
    one_visit = tying & m.same_visit
    state.undecided |= one_visit
    if chance_alike(borne_out, int((inside & ~state.accepted).sum())) <= most:
        before = replace(state, accepted=state.accepted.copy(), failures=state.failures.copy())
        take_in(m, state, params)
        refine(m, state, gate, 1.0, params)
        # Look-alikes that are taken for one place contradict each other sooner or later: then none of them tie.
        contradicted = int((doubtful & _within(m, state.accepted) & ~state.accepted).sum())
        if chance_alike(borne_out, contradicted) > most:
            state.accepted, state.failures, state.poses = before.accepted, before.failures, before.poses
        state.doubted = tying & state.accepted
    apart = tying & ~_within(m, state.accepted)
    state.undecided |= apart
    for row in np.flatnonzero(apart).tolist():
        others = "captured in one visit" if one_visit[row] else "so are others of this map, or they contradict it"
        state.pending[row] = f"places that look alike? ({others})"


def _within(m: Measurements, accepted: np.ndarray) -> np.ndarray:
    """(E,) bool: both scenes of the edge are in one component."""
    labels = component_labels(m, np.flatnonzero(accepted))
    found: np.ndarray = labels[m.targets] == labels[m.sources]
    return found


def chance_alike(borne_out: int, contradicted: int) -> float:
    """How probable it is that a further doubtful edge is of two places, by the rule of succession.

    Args:
        borne_out, contradicted: doubtful edges of this map of which the other edges say what they are.
    """
    return (contradicted + 1) / (borne_out + contradicted + 2)

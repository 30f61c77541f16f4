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
    if close_loops(m, state, params):
        refine(m, state, gate, 1.0, params)
    labels = component_labels(m, np.flatnonzero(state.accepted))
    inside = doubtful & (labels[m.targets] == labels[m.sources])
    alike = chance_alike(int((inside & state.accepted).sum()), int((inside & ~state.accepted).sum()))
    tying = doubtful & ~inside
    apart = tying & (m.same_visit | (alike > params.aliasing.max_chance_alike))
    state.undecided |= apart
    known = state.accepted.copy()
    take_in(m, state, params)
    refine(m, state, gate, 1.0, params)
    state.doubted = doubtful & state.accepted & ~known
    for row in np.flatnonzero(apart).tolist():
        state.pending[row] = "a place that looks alike? " + (
            "captured in one visit" if m.same_visit[row] else "other pairs of this map that disagree so are"
        )


def chance_alike(borne_out: int, contradicted: int) -> float:
    """How probable it is that a further doubtful edge is of two places, by the rule of succession.

    Args:
        borne_out, contradicted: doubtful edges of this map of which the other edges say what they are.
    """
    return (contradicted + 1) / (borne_out + contradicted + 2)

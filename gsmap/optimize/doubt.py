"""Edges whose captures disagree in what both saw: of one place that changed, or of two places that look alike.

No pair by itself can tell which. The map can: what the other edges bear out is one place that changed; what they
contradict is not. An edge that ties parts of the map which nothing else ties is held for a place that changed as long
as this map's doubtful edges mostly turned out so, and its scenes are tentative; where they mostly turned out to be of
other places, the parts stay apart.

Assumption: of one place captured twice without change nearly all of what both saw agrees, so edges without doubt are
right as often as any. It fails where rooms are repeated entirely, their furniture included; see
`gsmap.optimize.perceptual_aliasing` for what is left then.

How much is too much differs: noisy captures disagree more, and bare rooms less. So where edges contradict each other
the likeliest are taken in first, and the first that the map contradicts tell where doubt begins in it. Likelihood is
that of all that registration saw (`gsmap.optimize.likelihood`), for less disagrees where a facade repeats than where
two captures see a place from afar. Edges of unknown likelihood are ranked by disagreement.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmap.geometry.similarities import Similarities
from gsmap.optimize.consistency import consistent_with_component
from gsmap.optimize.growing import close_loops, take_in
from gsmap.optimize.measurements import Measurements
from gsmap.optimize.params import Params
from gsmap.optimize.priors import PriorTerms
from gsmap.optimize.state import State, refine
from gsmap.optimize.structure import component_labels

_MAX_CHANCE_ALIKE = 0.5  # doubtful edges join nothing where more of the map's decided ones were of two places
_COST = 10.0  # right edges in doubt that a wrong one believed is as bad as
_LEAST_SPREAD = 0.15  # of logarithms of disagreements, where few are known
_SCENE_STEPS, _FEWEST_STEPS = 2000, 8  # large maps take more in at a step, for each costs them a solve
_STEPS = 64  # in which edges are taken in by their likelihood, at most


def find_doubtful(m: Measurements, bar: float) -> np.ndarray:
    """(E,) bool: at least this much of what both scenes saw disagrees, and nobody vouches for the edge."""
    with np.errstate(invalid="ignore"):  # nobody looked: no doubt
        found: np.ndarray = (m.disagreement >= bar) & ~m.confirmed
    return found


def find_doubtful_in_map(
    m: Measurements, state: State, doubtful: np.ndarray, gate: float, params: Params
) -> np.ndarray:
    """(E,) bool: edges in doubt by ``max_disagreement`` or by the contradictions of this map.

    Where the map contradicts more of the doubtful edges than it bears out, it has look-alikes, and the bar is what best
    divides the disagreement of its other edges from that of those. Where the other edges contradict each other, those
    from `first_contradicted` on are in doubt as well.

    Args:
        state: of the map that the edges without doubt make.
    """
    bar = params.max_disagreement
    inside = _within(m, state.accepted)
    fits = np.zeros(len(m), dtype=bool)
    rows = np.flatnonzero(inside & doubtful)
    if len(rows):
        fits[rows] = consistent_with_component(m, rows, state.drift(m), params.gate_probability)
    contradicted = inside & doubtful & ~fits
    alike = chance_alike(int((inside & doubtful & fits).sum()), int(contradicted.sum()))
    believed = state.accepted & (m.disagreement > 0)
    if alike > _MAX_CHANCE_ALIKE and believed.any():
        bar = min(bar, dividing_bar(m.disagreement[believed], m.disagreement[contradicted]))
    found = find_doubtful(m, bar)
    if not (state.accepted | state.ambiguous | doubtful).all():
        found |= first_contradicted(m, ~(state.ambiguous | doubtful), state.terms, gate, params)
    return found


def dividing_bar(believed: np.ndarray, contradicted: np.ndarray) -> float:
    """What best divides two sets of disagreements, log-normal of one width, where a wrong edge costs as much as
    ``_COST`` right ones (Bayes); infinity where they do not differ that way round."""
    logs = [np.log(np.maximum(values, 1e-6)) for values in (believed, contradicted)]
    low, high = (float(np.median(values)) for values in logs)
    if high <= low:
        return float("inf")
    spread = np.concatenate([np.abs(values - middle) for values, middle in zip(logs, (low, high), strict=True)])
    sigma = max(_LEAST_SPREAD, 1.4826 * float(np.median(spread)))
    return float(np.exp((low + high) / 2 - sigma**2 * np.log(_COST) / (high - low)))


def first_contradicted(
    m: Measurements, eligible: np.ndarray, terms: PriorTerms, gate: float, params: Params
) -> np.ndarray:
    """(E,) bool: edges from the rank on at which edges are contradicted more often than not; none where no rank is.

    Edges are taken in the likeliest first, each tying whatever it ties; those that come late find their scenes tied.

    Args:
        eligible: (E,) bool, edges that are taken in; the others decide nothing.
    """
    rank, known = _ranked(m)
    tying = replace(params, min_large_component=m.num_scenes + 1)
    state = State.fresh(m, Similarities.identity(m.num_scenes), np.zeros(len(m), dtype=bool), terms)
    agrees, contradicted = np.zeros((2, len(m)), dtype=bool)
    steps = np.unique(rank[eligible])
    most = min(len(steps), _STEPS, max(_FEWEST_STEPS, _SCENE_STEPS // m.num_scenes))
    below = -1
    for step in np.unique(np.quantile(steps, np.linspace(0, 1, most), method="nearest")).tolist():
        state.rejected = (rank > step) | ~eligible
        new = (rank > below) & ~state.rejected
        tied = _within(m, state.accepted)
        take_in(m, state, tying)
        refine(m, state, gate)
        agrees |= new & tied & state.accepted
        contradicted |= new & _within(m, state.accepted) & ~state.accepted
        below = step
    for bar in np.unique(rank[contradicted & known]).tolist():
        above = rank >= bar
        if chance_alike(int((agrees & above).sum()), int((contradicted & above).sum())) > _MAX_CHANCE_ALIKE:
            return above & known
    return np.zeros(len(m), dtype=bool)


def _ranked(m: Measurements) -> tuple[np.ndarray, np.ndarray]:
    """(E,) rank of each edge, the likeliest 0, equals alike, and (E,) bool whether its likelihood is known; confirmed
    edges and those of unknown likelihood come first."""
    known = np.isfinite(m.log_odds_wrong)
    value = m.log_odds_wrong
    if not known.any():
        known, value = m.disagreement > 0, m.disagreement
    known = known & ~m.confirmed
    return np.unique(np.where(known, value, -np.inf), return_inverse=True)[1], known


def take_in_doubtful(m: Measurements, state: State, doubtful: np.ndarray, gate: float, params: Params) -> None:
    """Take in the doubtful edges that the map bears out, and by the others what nothing else ties, if this map's
    record allows it."""
    state.doubtful = doubtful
    if close_loops(m, state, params):
        refine(m, state, gate)
    inside = doubtful & _within(m, state.accepted)
    borne_out = int((inside & state.accepted).sum())
    tying = doubtful & ~inside
    one_visit = tying & m.same_visit
    state.undecided |= one_visit
    if chance_alike(borne_out, int((inside & ~state.accepted).sum())) <= _MAX_CHANCE_ALIKE:
        before = replace(state, accepted=state.accepted.copy(), failures=state.failures.copy())
        take_in(m, state, params)
        refine(m, state, gate)
        # Look-alikes that are taken for one place contradict each other sooner or later: then none of them tie.
        contradicted = int((doubtful & _within(m, state.accepted) & ~state.accepted).sum())
        if chance_alike(borne_out, contradicted) > _MAX_CHANCE_ALIKE:
            state.accepted, state.failures, state.poses = before.accepted, before.failures, before.poses
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

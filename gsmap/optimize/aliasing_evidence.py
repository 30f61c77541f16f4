"""Judge doubtful edges, whose captures may show two places that look alike: so does a place that changed much.

The pair alone does not decide between both; the map does. If the remaining edges support a doubtful edge, the place
changed; if they contradict it, there are two places. A doubtful edge that alone connects two parts of the map is
accepted, with tentative scenes, if most doubtful edges of this map turned out to be correct; otherwise the parts stay
separate.

The probability of two places (`gsmap.register.look_alike`) is low for rooms that are repeated entirely, including
their furniture; `gsmap.optimize.perceptual_aliasing` handles them.

The threshold of doubt depends on the map: noisy captures agree less. So where edges contradict each other, edges are
accepted in order of likelihood, and the first contradicted edges set the threshold. The likelihood uses all evidence of
registration (`gsmap.optimize.edge_likelihood`). Edges of unknown likelihood are ranked by disagreement.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmap.geometry.similarities import Similarities
from gsmap.optimize.component_growth import accept_edges, close_loops
from gsmap.optimize.consistency import consistent_with_component
from gsmap.optimize.measurements import Measurements
from gsmap.optimize.params import Params
from gsmap.optimize.priors import PriorTerms
from gsmap.optimize.state import State, refine
from gsmap.optimize.structure import component_labels
from gsmap.reason_codes import reason

_MAX_ALIASING_PROBABILITY = 0.5  # doubtful edges join no components if the aliasing probability of this map is higher
_COST = 10.0  # accepting a wrong edge costs as much as doubting this many correct edges
_LEAST_SPREAD = 0.15  # lower bound of the spread of log probabilities, for small samples
_SCENE_STEPS, _FEWEST_STEPS = 2000, 8  # large maps accept more edges per step, because each step costs a solve
_STEPS = 64  # maximum number of steps in which edges are accepted by likelihood


def find_doubtful(m: Measurements, bar: float) -> np.ndarray:
    """Return an (E,) mask that is True for doubtful edges: the probability of two places is above ``bar``, and
    no person confirmed the edge."""
    with np.errstate(invalid="ignore"):  # NaN: unknown, hence not doubtful
        found: np.ndarray = (m.look_alike > bar) & ~m.confirmed
    return found


def find_doubtful_in_map(
    m: Measurements, state: State, doubtful: np.ndarray, gate: float, params: Params
) -> np.ndarray:
    """Return an (E,) mask of doubtful edges, judged by ``max_look_alike`` and by the contradictions of this map.

    Where the map contradicts more doubtful edges than it supports, it has places that look alike; then the threshold
    best separates the probabilities of accepted edges from those of contradicted edges. Where undoubted edges
    contradict each other, the edges from `find_first_contradicted` are doubtful as well.

    Args:
        state: state of the map computed from undoubted edges alone.
    """
    bar = params.max_look_alike
    inside = _within(m, state.accepted)
    fits = np.zeros(len(m), dtype=bool)
    rows = np.flatnonzero(inside & doubtful)
    if len(rows):
        fits[rows] = consistent_with_component(m, rows, state.drift(m), params.gate_probability)
    contradicted = inside & doubtful & ~fits
    aliasing = aliasing_probability(int((inside & doubtful & fits).sum()), int(contradicted.sum()))
    accepted = state.accepted & (m.look_alike > 0)
    if aliasing > _MAX_ALIASING_PROBABILITY and accepted.any():
        bar = min(bar, separating_threshold(m.look_alike[accepted], m.look_alike[contradicted]))
    found = find_doubtful(m, bar)
    if not (state.accepted | state.ambiguous | doubtful).all():
        found |= find_first_contradicted(m, ~(state.ambiguous | doubtful), state.terms, gate, params)
    return found


def separating_threshold(accepted: np.ndarray, contradicted: np.ndarray) -> float:
    """Compute the threshold that best separates two log-normal sets of probabilities; infinity if they cannot be
    separated. The decision is Bayesian: accepting a wrong edge costs `_COST` times as much as doubting a correct edge.
    """
    logs = [np.log(np.maximum(values, 1e-6)) for values in (accepted, contradicted)]
    low, high = (float(np.median(values)) for values in logs)
    if high <= low:
        return float("inf")
    spread = np.concatenate([np.abs(values - middle) for values, middle in zip(logs, (low, high), strict=True)])
    sigma = max(_LEAST_SPREAD, 1.4826 * float(np.median(spread)))
    return float(np.exp((low + high) / 2 - sigma**2 * np.log(_COST) / (high - low)))


def find_first_contradicted(
    m: Measurements, eligible: np.ndarray, terms: PriorTerms, gate: float, params: Params
) -> np.ndarray:
    """Find the rank of likelihood from which on most edges are contradicted; return an (E,) mask of the edges from this
    rank on, all False if there is no such rank.

    Edges are accepted in order of likelihood. Early edges connect scenes; late edges, whose scenes are already
    connected, agree with the map or are contradicted.

    Args:
        eligible: (E,) mask of the edges that may be accepted; the remaining edges have no influence.
    """
    rank, known = _ranked(m)
    tying = replace(params, min_large_component=m.num_scenes + 1)
    state = State.fresh(m, Similarities.identity(m.num_scenes), np.zeros(len(m), dtype=bool), terms)
    agrees, contradicted = np.zeros((2, len(m)), dtype=bool)
    steps = np.unique(rank[eligible])
    max_steps = min(len(steps), _STEPS, max(_FEWEST_STEPS, _SCENE_STEPS // m.num_scenes))
    below = -1
    for step in np.unique(np.quantile(steps, np.linspace(0, 1, max_steps), method="nearest")).tolist():
        state.rejected = (rank > step) | ~eligible
        new = (rank > below) & ~state.rejected
        tied = _within(m, state.accepted)
        accept_edges(m, state, tying)
        refine(m, state, gate)
        agrees |= new & tied & state.accepted
        contradicted |= new & _within(m, state.accepted) & ~state.accepted
        below = step
    # A bar at the lowest rank separates nothing: a contradicted edge is then as likely as all the others.
    above_lowest = rank > rank[eligible & known].min(initial=len(m))
    for bar in np.unique(rank[contradicted & known & above_lowest]).tolist():
        above = rank >= bar
        if (
            aliasing_probability(int((agrees & above).sum()), int((contradicted & above).sum()))
            > _MAX_ALIASING_PROBABILITY
        ):
            return above & known
    return np.zeros(len(m), dtype=bool)


def _ranked(m: Measurements) -> tuple[np.ndarray, np.ndarray]:
    """Rank edges by likelihood: return the (E,) rank, 0 for the likeliest, and an (E,) mask that is True where the
    likelihood is known. Confirmed edges and edges of unknown likelihood come first."""
    known = np.isfinite(m.log_odds_wrong)
    value = m.log_odds_wrong
    if not known.any():
        known, value = m.disagreement > 0, m.disagreement
    known = known & ~m.confirmed
    return np.unique(np.where(known, value, -np.inf), return_inverse=True)[1], known


def accept_doubtful_edges(m: Measurements, state: State, doubtful: np.ndarray, gate: float, params: Params) -> None:
    """Accept the doubtful edges that the map supports. If most doubtful edges of this map were correct, also accept
    doubtful edges that connect components."""
    state.doubtful = doubtful
    if close_loops(m, state, params):
        refine(m, state, gate)
    inside = doubtful & _within(m, state.accepted)
    supported = int((inside & state.accepted).sum())
    joining = doubtful & ~inside
    one_visit = joining & m.same_visit
    state.undecided |= one_visit
    if aliasing_probability(supported, int((inside & ~state.accepted).sum())) <= _MAX_ALIASING_PROBABILITY:
        before = replace(state, accepted=state.accepted.copy(), failures=state.failures.copy())
        accept_edges(m, state, params)
        refine(m, state, gate)
        # Edges between places that look alike contradict each other sooner or later; then none of these edges is
        # accepted.
        contradicted = int((doubtful & _within(m, state.accepted) & ~state.accepted).sum())
        if aliasing_probability(supported, contradicted) > _MAX_ALIASING_PROBABILITY:
            state.accepted, state.failures, state.poses = before.accepted, before.failures, before.poses
    apart = joining & ~_within(m, state.accepted)
    state.undecided |= apart
    for row in np.flatnonzero(apart).tolist():
        others = (
            "captured in one visit" if one_visit[row] else "other places of this map do, or other edges contradict it"
        )
        state.pending[row] = reason("aliased_places", f"places that look alike? ({others})")


def _within(m: Measurements, accepted: np.ndarray) -> np.ndarray:
    """Return an (E,) mask that is True if both scenes of the edge are in one component."""
    labels = component_labels(m, np.flatnonzero(accepted))
    found: np.ndarray = labels[m.targets] == labels[m.sources]
    return found


def aliasing_probability(supported: int, contradicted: int) -> float:
    """Estimate the probability that a further doubtful edge joins two different places, by the rule of succession.

    Args:
        supported, contradicted: number of doubtful edges of this map that the remaining edges support, and that they
            contradict.
    """
    return (contradicted + 1) / (supported + contradicted + 2)

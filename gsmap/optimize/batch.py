"""The batch solve: all edges in, one map out, in as many components as the evidence ties together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gsmap.errors import InputError
from gsmap.geometry.chi_square import chi2_quantile
from gsmap.geometry.similarities import Similarities
from gsmap.optimize.contradictions import CONTRADICTION_GATES, contested, part_contradicted
from gsmap.optimize.cycles import Vote, vote
from gsmap.optimize.doubt import find_doubtful, find_doubtful_in_map, take_in_doubtful
from gsmap.optimize.final import solve_components
from gsmap.optimize.fingerprint import fingerprint
from gsmap.optimize.growing import attach_singles, close_through_singles, cut_weak_bridges, take_in, take_in_agreeing
from gsmap.optimize.measurements import Measurements, all_rigid, check_priors, measurements
from gsmap.optimize.params import Params
from gsmap.optimize.perceptual_aliasing import contradicted_priors, resolve_aliased_loops
from gsmap.optimize.priors import PriorTerms
from gsmap.optimize.recipe import recipe_key
from gsmap.optimize.report import pose_graph
from gsmap.optimize.robust import Descent, chi_squares, chordal
from gsmap.optimize.state import State, initial_state, refine
from gsmap.optimize.structure import component_labels, roots
from gsmap.types import Edge, PoseGraph, Prior, Provenance
from gsmap.types.progress import Progress
from gsmap.types.world import Survey

_GNC_START_GATES = 16.0  # width at which the robust kernel of graduated non-convexity starts
_MAX_ROUNDS = 30  # of taking edges in and refining


def solve_batch(
    scene_ids: Sequence[str],
    edges: Sequence[Edge],
    priors: Sequence[Prior],
    previous: PoseGraph | None,
    params: Params,
    progress: Progress,
    survey: Survey,
) -> PoseGraph:
    """See `gsmap.optimize.optimize`; edges and priors come sorted by id."""
    check_priors(scene_ids, priors)
    # Rows are numbered by id: where the solve starts, and what it does first among equals, is the same in any order.
    m = measurements(sorted(scene_ids), edges, rigid=all_rigid(edges, priors, previous))
    gate = float(chi2_quantile(params.gate_probability, m.dim))

    terms = PriorTerms.stack(m.scene_ids, priors)
    doubtful = find_doubtful(m, params.max_disagreement)
    state, votes = _grown_from(m, ~doubtful, terms, gate, params, progress)
    if (m.disagreement > 0).any() and not state.accepted.all():
        stricter = find_doubtful_in_map(m, state, doubtful, gate, params)
        if (stricter & ~doubtful).any():
            doubtful = stricter
            state, votes = _grown_from(m, ~doubtful, terms, gate, params, progress)
    if doubtful.any():
        # What can be believed makes the map; only then is what may be of other places held against it.
        take_in_doubtful(m, state, doubtful, gate, params)
    _reconsider(m, state, gate)
    _check_confirmed(m, state, gate)

    solved = solve_components(
        m, state, _ages(m, scene_ids), previous, params, lambda f, text: progress(0.75 + 0.25 * f, text), survey
    )
    answer = pose_graph(m, solved.poses, solved.component, solved.covariances, state, votes, params)
    return replace(
        answer,
        poses={scene: answer.poses[scene] for scene in scene_ids},
        provenance=_provenance(m, edges, priors, state, params, survey),
        notes=solved.notes,
        world=solved.world,
    )


def _grown_from(
    m: Measurements, believed: np.ndarray, terms: PriorTerms, gate: float, params: Params, progress: Progress
) -> tuple[State, Vote]:
    """Components grown from some of the edges alone; the others are open."""
    if believed.all():
        return _grown(m, terms, gate, params, progress)
    rows = np.flatnonzero(believed)
    state, votes = _grown(m[rows], terms, gate, params, progress)
    return state.spread(rows, len(m)), votes.spread(rows, len(m))


def _grown(m: Measurements, terms: PriorTerms, gate: float, params: Params, progress: Progress) -> tuple[State, Vote]:
    """Components grown from all edges of ``m``, parted where places look alike, and what the cycles say."""
    progress(0.05, "voting on cycles")
    votes = vote(m, params.gate_probability)
    state = initial_state(m, votes, terms, params)
    refine(m, state, gate, _GNC_START_GATES)
    for turn in range(_MAX_ROUNDS):
        progress(0.1 + 0.6 * turn / _MAX_ROUNDS, "growing components")
        if take_in_agreeing(m, state, params):
            cut_weak_bridges(m, state, params)
            refine(m, state, gate)
        elif close_through_singles(m, state, params):
            refine(m, state, gate)
        elif not _part_aliased(m, votes, state, gate, params):
            break
    attach_singles(m, state, params)
    while part_contradicted(m, state, params):
        refine(m, state, gate)
        take_in(m, state, params)
    state.ambiguous |= contested(m, state, params)
    return state, votes


def _ages(m: Measurements, scene_ids: Sequence[str]) -> np.ndarray:
    """(N,) place of each scene in the caller's order, oldest first."""
    came = {scene: k for k, scene in enumerate(scene_ids)}
    return np.array([came[scene] for scene in m.scene_ids], dtype=np.int64)


def _provenance(
    m: Measurements,
    edges: Sequence[Edge],
    priors: Sequence[Prior],
    state: State,
    params: Params,
    survey: Survey,
) -> Provenance:
    believed = {m.scene_ids[k] for k in state.terms.scenes.tolist()}
    return Provenance(
        method="batch",
        recipe=recipe_key(params).recipe,
        batch_scenes=m.num_scenes,
        measured=f"{fingerprint(edges, priors, survey) % 2**64:016x}",
        contradicted_priors=tuple(p.scene for p in priors if p.scene not in believed),
    )


def _part_aliased(m: Measurements, votes: Vote, state: State, gate: float, params: Params) -> bool:
    """Part components where a group of edges contradicts them and is not clearly outweighed."""
    settled = state.undecided | state.rejected
    found = resolve_aliased_loops(m, state.accepted, settled, state.poses, votes, params)
    if len(state.terms):
        elsewhere, outweighed = contradicted_priors(m, state.accepted, state.poses, votes, state.terms)
        found.wrong |= elsewhere
        state.terms = state.terms[np.flatnonzero(~outweighed)]
    if not (found.wrong | found.undecided).any():
        return False
    state.accepted &= ~(found.wrong | found.undecided)
    state.undecided |= found.undecided
    state.rejected |= found.wrong
    state.failures[found.right] = 0
    refine(m, state, gate)
    return True


def _reconsider(m: Measurements, state: State, gate: float) -> None:
    """Take back edges that failed on the way and fit now."""
    labels = component_labels(m, np.flatnonzero(state.accepted))
    inside = labels[m.targets] == labels[m.sources]
    state.accepted |= inside & ~state.undecided & ~state.rejected & (chi_squares(m, state.poses) < gate)


def _check_confirmed(m: Measurements, state: State, gate: float) -> None:
    """Confirmed edges are never voted out, so they must at least not contradict each other."""
    rows = np.flatnonzero(m.confirmed)
    if len(rows) < 2:
        return
    off = chi_squares(m[rows], state.poses) > CONTRADICTION_GATES * gate
    if not off.any():
        return
    # They may only be at odds with edges that nobody confirmed: solve them alone.
    alone = m[rows]
    labels = component_labels(alone, np.arange(len(rows)))
    fixed = np.zeros(m.num_scenes, dtype=bool)
    fixed[roots(labels)] = True
    start = chordal(alone, fixed, Similarities.identity(m.num_scenes))
    poses = Descent(alone, fixed).fit(start)
    worst = chi_squares(alone, poses)
    if worst.max() > CONTRADICTION_GATES * gate:
        target, source = alone.keys[int(np.argmax(worst))]
        raise InputError(
            f"confirmed edge {target}:{source} contradicts the other confirmed edges: reject it, or one of them",
            code="confirmed_edges_contradict",
        )

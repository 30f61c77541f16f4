"""Batch solve: compute the poses of all scenes from all edges, in as many components as the edges connect."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gsmap.errors import InputError
from gsmap.geometry.chi_square import chi2_quantile
from gsmap.geometry.similarities import Similarities
from gsmap.optimize.aliasing_evidence import accept_doubtful_edges, find_doubtful, find_doubtful_in_map
from gsmap.optimize.component_growth import (
    accept_agreeing_edges,
    accept_edges,
    attach_by_single_edges,
    close_loops_through_single_edges,
    cut_weak_bridges,
)
from gsmap.optimize.consistency import consistent_with_component
from gsmap.optimize.contradictions import CONTRADICTION_GATES, exclude_contradicted, find_contested_edges
from gsmap.optimize.cycles import CycleSupport, count_cycle_support
from gsmap.optimize.duplicates import find_repeated
from gsmap.optimize.final_solve import solve_components
from gsmap.optimize.fingerprint import fingerprint
from gsmap.optimize.measurements import Measurements, all_rigid, check_priors, measurements
from gsmap.optimize.params import Params
from gsmap.optimize.perceptual_aliasing import contradicted_priors, resolve_aliased_loops
from gsmap.optimize.priors import PriorTerms
from gsmap.optimize.recipe import recipe_key
from gsmap.optimize.report import pose_graph
from gsmap.optimize.robust import GaussNewton, chi_squares, chordal
from gsmap.optimize.state import State, initial_state, refine
from gsmap.optimize.structure import component_labels, roots
from gsmap.types import Edge, PoseGraph, Prior, Provenance
from gsmap.types.world import Survey

_GNC_START_GATES = 16.0  # initial width of the robust kernel of graduated non-convexity, in gates
_MAX_ROUNDS = 30  # of accepting edges and refining


def solve_batch(
    scene_ids: Sequence[str],
    edges: Sequence[Edge],
    priors: Sequence[Prior],
    previous: PoseGraph | None,
    params: Params,
    survey: Survey,
) -> PoseGraph:
    """Solve a map as `gsmap.optimize.optimize` does; edges and priors must be sorted by id."""
    check_priors(scene_ids, priors)
    # Rows are sorted by id, so that neither the initial poses nor the breaking of ties depends on the order of input.
    m = measurements(sorted(scene_ids), edges, rigid=all_rigid(edges, priors, previous))
    gate = float(chi2_quantile(params.gate_probability, m.dim))

    terms = PriorTerms.stack(m.scene_ids, priors)
    repeated = find_repeated(m)
    if repeated.any():
        rows = np.flatnonzero(~repeated)
        state, cycles = _robust(m[rows], terms, gate, params)
        state, cycles = state.spread(rows, len(m)), cycles.spread(rows, len(m))
        _accept_repeated(m, state, repeated, gate, params)
    else:
        state, cycles = _robust(m, terms, gate, params)
    _reconsider(m, state, gate)
    _check_confirmed(m, state, gate)

    solved = solve_components(m, state, _ages(m, scene_ids), previous, params, survey)
    answer = pose_graph(m, solved.poses, solved.component, solved.covariances, state, cycles, params)
    return replace(
        answer,
        poses={scene: answer.poses[scene] for scene in scene_ids},
        provenance=_provenance(m, edges, priors, state, params, survey),
        notes=solved.notes,
        world=solved.world,
    )


def _robust(m: Measurements, terms: PriorTerms, gate: float, params: Params) -> tuple[State, CycleSupport]:
    """Solve robustly for the poses and the accepted edges, doubtful edges included."""
    doubtful = find_doubtful(m, params.max_look_alike)
    state, cycles = _grown_from(m, ~doubtful, terms, gate, params)
    is_judged = (m.look_alike > 0) | (m.disagreement > 0)  # the latter alone by older versions of registration
    if is_judged.any() and not state.accepted.all():
        stricter = find_doubtful_in_map(m, state, doubtful, gate, params)
        if (stricter & ~doubtful).any():
            doubtful = stricter
            state, cycles = _grown_from(m, ~doubtful, terms, gate, params)
    if doubtful.any():
        # The map is built from undoubted edges; doubtful edges, which may join different places, are compared with it
        # later.
        accept_doubtful_edges(m, state, doubtful, gate, params)
    return state, cycles


def _accept_repeated(m: Measurements, state: State, repeated: np.ndarray, gate: float, params: Params) -> None:
    """Accept the repeated edges that agree with the component of their scenes; they join no components."""
    rows = np.flatnonzero(repeated)
    fits = rows[consistent_with_component(m, rows, state.drift(m), params.gate_probability)]
    state.accepted[fits] = True
    refine(m, state, gate)


def _grown_from(
    m: Measurements, undoubted: np.ndarray, terms: PriorTerms, gate: float, params: Params
) -> tuple[State, CycleSupport]:
    """Grow components from the edges in ``undoubted``; the remaining edges are neither accepted nor rejected."""
    if undoubted.all():
        return _grown(m, terms, gate, params)
    rows = np.flatnonzero(undoubted)
    state, cycles = _grown(m[rows], terms, gate, params)
    return state.spread(rows, len(m)), cycles.spread(rows, len(m))


def _grown(m: Measurements, terms: PriorTerms, gate: float, params: Params) -> tuple[State, CycleSupport]:
    """Grow components from all edges of ``m``, and split them where places look alike; also return the cycle support of
    the edges."""
    cycles = count_cycle_support(m, params.gate_probability)
    state = initial_state(m, cycles, terms, params)
    refine(m, state, gate, _GNC_START_GATES)
    for _ in range(_MAX_ROUNDS):
        if accept_agreeing_edges(m, state, params):
            cut_weak_bridges(m, state, params)
            refine(m, state, gate)
        elif close_loops_through_single_edges(m, state, params):
            refine(m, state, gate)
        elif not _part_aliased(m, cycles, state, gate, params):
            break
    attach_by_single_edges(m, state, params)
    while exclude_contradicted(m, state, params):
        refine(m, state, gate)
        accept_edges(m, state, params)
    state.ambiguous |= find_contested_edges(m, state, params)
    return state, cycles


def _ages(m: Measurements, scene_ids: Sequence[str]) -> np.ndarray:
    """Return the (N,) age rank of each scene, 0 for the oldest, from the caller's order."""
    rank = {scene: k for k, scene in enumerate(scene_ids)}
    return np.array([rank[scene] for scene in m.scene_ids], dtype=np.int64)


def _provenance(
    m: Measurements,
    edges: Sequence[Edge],
    priors: Sequence[Prior],
    state: State,
    params: Params,
    survey: Survey,
) -> Provenance:
    trusted = {m.scene_ids[k] for k in state.terms.scenes.tolist()}
    return Provenance(
        method="batch",
        recipe=recipe_key(params).recipe,
        batch_scenes=m.num_scenes,
        measured=f"{fingerprint(edges, priors, survey) % 2**64:016x}",
        contradicted_priors=tuple(p.scene for p in priors if p.scene not in trusted),
    )


def _part_aliased(m: Measurements, cycles: CycleSupport, state: State, gate: float, params: Params) -> bool:
    """Split components where a group of edges contradicts the map and is not clearly outweighed; return whether any was
    split."""
    settled = state.undecided | state.rejected
    found = resolve_aliased_loops(m, state.accepted, settled, state.poses, cycles, params)
    if len(state.terms):
        elsewhere, outweighed = contradicted_priors(m, state.accepted, state.poses, cycles, state.terms)
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
    """Accept edges that failed before but fit now."""
    labels = component_labels(m, np.flatnonzero(state.accepted))
    inside = labels[m.targets] == labels[m.sources]
    state.accepted |= inside & ~state.undecided & ~state.rejected & (chi_squares(m, state.poses) < gate)


def _check_confirmed(m: Measurements, state: State, gate: float) -> None:
    """Raise `InputError` if confirmed edges, which are never excluded, contradict each other."""
    rows = np.flatnonzero(m.confirmed)
    if len(rows) < 2:
        return
    off = chi_squares(m[rows], state.poses) > CONTRADICTION_GATES * gate
    if not off.any():
        return
    # Confirmed edges may contradict only unconfirmed edges: solve the confirmed edges alone.
    alone = m[rows]
    labels = component_labels(alone, np.arange(len(rows)))
    fixed = np.zeros(m.num_scenes, dtype=bool)
    fixed[roots(labels)] = True
    start = chordal(alone, fixed, Similarities.identity(m.num_scenes))
    poses = GaussNewton(alone, fixed).fit(start)
    worst = chi_squares(alone, poses)
    if worst.max() > CONTRADICTION_GATES * gate:
        target, source = alone.keys[int(np.argmax(worst))]
        raise InputError(
            f"confirmed edge {target}:{source} contradicts the other confirmed edges: reject this edge or one of those",
            code="confirmed_edges_contradict",
        )

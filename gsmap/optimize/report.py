"""Convert a solution to a pose graph with scenes and edges by id, and state the reasons for excluded edges."""

from __future__ import annotations

import numpy as np

from gsmap.geometry.chi_square import chi2_quantile
from gsmap.geometry.similarities import Similarities
from gsmap.optimize.cycles import CycleSupport
from gsmap.optimize.duplicates import find_repeated
from gsmap.optimize.measurements import Measurements
from gsmap.optimize.params import Params
from gsmap.optimize.robust import chi_squares
from gsmap.optimize.state import State
from gsmap.optimize.structure import bridges, component_labels
from gsmap.reason_codes import reason
from gsmap.types import EdgeOutcome, PoseGraph, ScenePose
from gsmap.types.plain import plain

_REPEATED = reason("unconfirmed", "repeats another edge, because one of its scenes is a duplicate")


def pose_graph(
    m: Measurements,
    poses: Similarities,
    component: np.ndarray,
    covariances: np.ndarray,
    state: State,
    cycles: CycleSupport,
    params: Params,
) -> PoseGraph:
    """Build the `PoseGraph` of scenes and edges by id; the caller adds its provenance."""
    repeated = find_repeated(m)
    sure = state.accepted & ~state.doubtful & ~repeated
    tied = component_labels(m, np.flatnonzero(sure))
    supported = state.accepted & state.doubtful & (tied[m.targets] == tied[m.sources])
    if not (state.doubtful & ~state.accepted).any():
        sure |= supported  # an edge between two different places does not close a cycle by chance
    firm = sure & (~bridges(m, sure) | m.confirmed | m.duplicate)
    # Otherwise a doubtful or repeated edge confirms no other edge, and only the remaining edges confirm it.
    blocks = component_labels(m, np.flatnonzero(firm))
    firm |= state.accepted & (state.doubtful | repeated) & (blocks[m.targets] == blocks[m.sources])
    status = _statuses(m, state.accepted, firm)
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
        outcomes=_outcomes(m, poses, component, firm, repeated, status, state, cycles, params),
        settings=plain(params),
    )


def _outcomes(
    m: Measurements,
    poses: Similarities,
    component: np.ndarray,
    firm: np.ndarray,
    repeated: np.ndarray,
    status: np.ndarray,
    state: State,
    cycles: CycleSupport,
    params: Params,
) -> dict[tuple[str, str], EdgeOutcome]:
    gate = float(chi2_quantile(params.gate_probability, m.dim))
    chi = chi_squares(m, poses)
    together = component[m.targets] == component[m.sources]
    out: dict[tuple[str, str], EdgeOutcome] = {}
    for k, key in enumerate(m.keys):
        residual = float(chi[k]) if together[k] else None
        if firm[k]:
            out[key] = EdgeOutcome("used", residual)
        elif state.accepted[k] and state.doubtful[k]:
            why = reason("surfaces_differ", f"{_doubt_text(m, k, params)}, or one that changed")
            out[key] = EdgeOutcome("tentative", residual, why)
        elif state.accepted[k]:
            why = _REPEATED if repeated[k] else reason("unconfirmed", "in no agreeing cycle: no other edge confirms it")
            out[key] = EdgeOutcome("tentative", residual, why)
        elif not together[k]:
            why = state.pending.get(k) or reason(
                "contradicts_component", "contradicts other edges between the two components"
            )
            if repeated[k]:
                why = _REPEATED
            if state.doubtful[k]:
                why = reason("surfaces_differ", f"{_doubt_text(m, k, params)}; {why}")
            elif state.ambiguous[k]:
                why = reason(
                    "contradicts_edge",
                    "contradicts an edge whose evidence is about as good: one of both joins two places that look alike",
                )
            elif state.undecided[k]:
                why = reason(
                    "contradicting_groups",
                    "edges that agree among themselves contradict another such group here: places that look alike?",
                )
            out[key] = EdgeOutcome("unused", None, why, undecided=True)
        else:
            why = reason("contradicts_edges", f"contradicts the other edges: chi-square {chi[k]:.0f}, limit {gate:.0f}")
            if cycles.agree[k] > 0:
                why += "; other edges that contradict them agree with it (a place that looks alike?)"
            if state.doubtful[k]:
                why += f"; {_doubt_text(m, k, params)}"
            doubtful = "tentative" in (status[m.targets[k]], status[m.sources[k]])
            undecided = bool(cycles.agree[k] > 0 or doubtful or state.undecided[k] or state.rejected[k])
            out[key] = EdgeOutcome("unused", residual, why, undecided)
    return out


def _doubt_text(m: Measurements, row: int, params: Params) -> str:
    if not m.look_alike[row] > params.max_look_alike:  # nor if it is unknown
        return "edges of this map that are as likely contradict others: they may join two places that look alike"
    return f"the captures show two places that look alike with a probability of {m.look_alike[row]:.0%}"


def _statuses(m: Measurements, accepted: np.ndarray, firm: np.ndarray) -> np.ndarray:
    """Return the (N,) status of each scene: ``placed`` in the largest firmly connected part of its component,
    ``tentative`` elsewhere in it, ``isolated`` without edges."""
    component = component_labels(m, np.flatnonzero(accepted))
    blocks = component_labels(m, np.flatnonzero(firm))
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

"""State of the robust solve: poses and accepted edges, with their initialization and refinement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.geometry.similarities import Similarities
from gsmap.optimize.consistency import consistent_with_component
from gsmap.optimize.cycles import CycleSupport
from gsmap.optimize.drift import DriftModel
from gsmap.optimize.measurements import Measurements
from gsmap.optimize.params import Params
from gsmap.optimize.priors import PriorTerms
from gsmap.optimize.robust import GaussNewton, chi_squares, chordal, spanning_tree_init
from gsmap.optimize.structure import component_labels, roots

_MAX_FAILURES = 2  # an edge that was excluded this often is not accepted again
_RESTART_GATES = 4.0  # if an edge has a larger residual, poses start from chordal relaxation instead


@dataclass(eq=False)
class State:
    """Current poses of the scenes, and the edges that are accepted.

    Args:
        poses: N poses.
        accepted: (E,) mask of accepted edges.
        failures: (E,) number of times that an edge was accepted and excluded again.
        undecided, rejected: (E,) masks of edges that perceptual aliasing leaves undecided, and of wrong edges.
        terms: priors in use.
        pending: reason by row of an edge why the edge's components may not join.
        doubtful: (E,) mask of edges whose captures may show two places that look alike.
        ambiguous: (E,) mask of edges that contradict each other without evidence to decide.
    """

    poses: Similarities
    accepted: np.ndarray
    failures: np.ndarray
    undecided: np.ndarray
    rejected: np.ndarray
    terms: PriorTerms
    pending: dict[int, str]
    doubtful: np.ndarray
    ambiguous: np.ndarray

    @classmethod
    def fresh(cls, m: Measurements, poses: Similarities, accepted: np.ndarray, terms: PriorTerms) -> State:
        """Return a state in which no edge has failed yet."""
        failures = np.zeros(len(m), dtype=np.int64)
        # Separate arrays, which change in place.
        undecided, rejected, doubtful, ambiguous = np.zeros((4, len(m)), dtype=bool)
        return cls(poses, accepted, failures, undecided, rejected, terms, {}, doubtful, ambiguous)

    def spread(self, rows: np.ndarray, count: int) -> State:
        """Extend the state of the edges at ``rows`` to all ``count`` edges; the remaining edges are not accepted."""

        def put(values: np.ndarray) -> np.ndarray:
            out = np.zeros(count, dtype=values.dtype)
            out[rows] = values
            return out

        return State(
            self.poses,
            put(self.accepted),
            put(self.failures),
            put(self.undecided),
            put(self.rejected),
            self.terms,
            {int(rows[row]): reason for row, reason in self.pending.items()},
            put(self.doubtful),
            put(self.ambiguous),
        )

    def open(self) -> np.ndarray:
        """Return the rows of the edges that may still be accepted."""
        settled = self.accepted | self.undecided | self.rejected
        return np.flatnonzero(~settled & (self.failures < _MAX_FAILURES))

    def drift(self, m: Measurements) -> DriftModel:
        """Return the drift model along the accepted edges."""
        return DriftModel.over(m, np.flatnonzero(self.accepted), self.poses)


def initial_state(m: Measurements, cycles: CycleSupport, terms: PriorTerms, params: Params) -> State:
    """Initialize poses along the best supported edges, and accept those supported edges that agree with the poses."""
    accepted = (cycles.agree > 0) | m.confirmed
    rows = np.flatnonzero(accepted)
    # Confirmed edges come first, then edges sorted by the support of their neighbours, then by certainty.
    certainty = np.trace(m.covariance[rows], axis1=1, axis2=2)
    order = np.lexsort((certainty, -cycles.support[rows], ~m.confirmed[rows]))
    cost = np.empty(len(rows))
    cost[order] = np.arange(1, len(rows) + 1)
    poses = spanning_tree_init(m, rows, cost, Similarities.identity(m.num_scenes))
    if len(rows):
        drift = DriftModel.over(m, rows, poses)
        accepted[rows] = consistent_with_component(m, rows, drift, params.gate_probability) | m.confirmed[rows]
    return State.fresh(m, poses, accepted, terms)


def refine(m: Measurements, state: State, gate: float, widest: float = 1.0) -> None:
    """Refine the poses of every component robustly from its accepted edges, and exclude edges that do not fit.

    Args:
        gate: largest chi-square of an edge that fits.
        widest: initial width of the robust kernel, in gates.
    """
    rows = np.flatnonzero(state.accepted)
    if not len(rows):
        return
    fixed = np.zeros(m.num_scenes, dtype=bool)
    fixed[roots(component_labels(m, rows))] = True
    edges = m[rows]
    if (chi_squares(edges, state.poses) > _RESTART_GATES * gate).any():
        state.poses = chordal(edges, fixed, state.poses)
    descent = GaussNewton(edges, fixed)
    state.poses = descent.solve_gnc(state.poses, gate, widest, edges.confirmed)
    bad = (chi_squares(edges, state.poses) > gate) & ~edges.confirmed
    state.accepted[rows[bad]] = False
    state.failures[rows[bad]] += 1

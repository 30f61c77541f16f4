"""What the solve believes at the moment, its start, and its refinement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.geometry.similarities import Similarities
from gsmap.optimize.consistency import consistent_with_component
from gsmap.optimize.cycles import Vote
from gsmap.optimize.drift import DriftModel
from gsmap.optimize.measurements import Measurements
from gsmap.optimize.params import Params
from gsmap.optimize.priors import PriorTerms
from gsmap.optimize.robust import Descent, chi_squares, chordal, spanning_tree_init
from gsmap.optimize.structure import component_labels, roots

_MAX_FAILURES = 2  # an edge that was excluded so often is not taken in again
_RESTART_GATES = 4.0  # poses from which an edge is further off are no start for Gauss-Newton; chordal relaxation is


@dataclass(eq=False)
class State:
    """Where scenes are, and which edges are taken in.

    Args:
        poses: N. accepted: (E,) bool, edges taken in.
        failures: (E,) how often an edge was taken in and let go.
        undecided, rejected: (E,) bool, edges that places that look alike leave open, or that are surely wrong.
        terms: priors that are believed.
        pending: by edge, why the components that it ties may not join.
        doubtful: (E,) bool, edges whose captures disagree in too much of what both show.
        ambiguous: (E,) bool, edges that contradict each other and of which the evidence does not tell which is wrong.
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
        """Nothing has failed yet."""
        failures = np.zeros(len(m), dtype=np.int64)
        undecided, rejected, doubtful, ambiguous = np.zeros((4, len(m)), dtype=bool)  # they change in place
        return cls(poses, accepted, failures, undecided, rejected, terms, {}, doubtful, ambiguous)

    def spread(self, rows: np.ndarray, count: int) -> State:
        """The state of the edges at ``rows`` as that of all ``count``, of which the others are not taken in."""

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
            {int(rows[row]): why for row, why in self.pending.items()},
            put(self.doubtful),
            put(self.ambiguous),
        )

    def open(self) -> np.ndarray:
        """Rows of the edges that may still be taken in."""
        settled = self.accepted | self.undecided | self.rejected
        return np.flatnonzero(~settled & (self.failures < _MAX_FAILURES))

    def drift(self, m: Measurements) -> DriftModel:
        """How far predictions along the accepted edges may be off."""
        return DriftModel.over(m, np.flatnonzero(self.accepted), self.poses)


def initial_state(m: Measurements, votes: Vote, terms: PriorTerms, params: Params) -> State:
    """Poses along the best supported edges; the supported edges that agree with them are taken in."""
    accepted = (votes.agree > 0) | m.confirmed
    rows = np.flatnonzero(accepted)
    # Confirmed edges first, then what neighbours support, then the more certain measurement.
    certainty = np.trace(m.covariance[rows], axis1=1, axis2=2)
    order = np.lexsort((certainty, -votes.support[rows], ~m.confirmed[rows]))
    cost = np.empty(len(rows))
    cost[order] = np.arange(1, len(rows) + 1)
    poses = spanning_tree_init(m, rows, cost, Similarities.identity(m.num_scenes))
    if len(rows):
        drift = DriftModel.over(m, rows, poses)
        accepted[rows] = consistent_with_component(m, rows, drift, params.gate_probability) | m.confirmed[rows]
    return State.fresh(m, poses, accepted, terms)


def refine(m: Measurements, state: State, gate: float, widest: float = 1.0) -> None:
    """Robust poses of every component from its accepted edges; edges that do not fit are let go.

    Args:
        gate: chi-square up to which an edge fits.
        widest: width in gates at which the robust kernel starts.
    """
    rows = np.flatnonzero(state.accepted)
    if not len(rows):
        return
    fixed = np.zeros(m.num_scenes, dtype=bool)
    fixed[roots(component_labels(m, rows))] = True
    edges = m[rows]
    if (chi_squares(edges, state.poses) > _RESTART_GATES * gate).any():
        state.poses = chordal(edges, fixed, state.poses)
    descent = Descent(edges, fixed)
    state.poses = descent.solve_gnc(state.poses, gate, widest, edges.confirmed)
    bad = (chi_squares(edges, state.poses) > gate) & ~edges.confirmed
    state.accepted[rows[bad]] = False
    state.failures[rows[bad]] += 1

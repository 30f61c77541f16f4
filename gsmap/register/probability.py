"""Compute the probability that a pose is correct from all its evidence.

An additive logistic model: every piece of evidence adds log-odds along a monotone, piecewise linear curve. The curves
are fitted by ``tools/fit/verdict.py`` on synthetic places with the defects of real captures, and stored beside this
file; no real capture was used.
"""

from __future__ import annotations

from functools import lru_cache
from importlib.resources import files

import numpy as np

from gsmap.compare.odds import Curve, Odds
from gsmap.register.evidence import PoseEvidence
from gsmap.types.registration import Proposal

__all__ = ["Curve", "Model", "evidence_of", "probability", "shortfalls", "worth"]

VERSION = 1

_FILE = "probability.json"


class Model(Odds):
    """Fitted curves of the pieces of evidence that `evidence_of` returns."""

    @classmethod
    def load(cls) -> Model:
        """Load the model that gsmap ships."""
        return _shipped()


@lru_cache(maxsize=1)
def _shipped() -> Model:
    return Model.of_json((files("gsmap.register") / _FILE).read_text())


def evidence_of(proposal: Proposal, evidence: PoseEvidence) -> dict[str, float]:
    """Return the pieces of evidence for a pose as inputs of the curves; NaN where a piece is missing.

    Logarithms make equal steps about equally meaningful.
    """
    through_cameras = evidence.num_seen > 0
    nfa = proposal.log_nfa
    return {
        "log_nfa": float("nan") if np.isnan(nfa) else float(np.clip(nfa, -300, 30)),
        "runner_up": proposal.runner_up,
        "free_space_violation": float(np.log10(evidence.free_space_violation + 1e-3)),
        "disagreement": float(np.log10(evidence.disagreement + 1e-3)),
        "overlap": float(np.log10(evidence.overlap + 1e-2)),
        "num_coinciding": float(np.log10(evidence.num_coinciding + 10)),
        "colour_correlation": evidence.colour_correlation if through_cameras else float("nan"),
        "colour_t": float(np.log10(np.clip(evidence.colour_t, 1.0, None))) if through_cameras else float("nan"),
    }


def worth(proposal: Proposal, evidence: PoseEvidence, model: Model | None = None) -> dict[str, float]:
    """Return the log-odds that each piece of evidence adds, by the name of the piece."""
    return (model or Model.load()).worth(evidence_of(proposal, evidence))


def shortfalls(proposal: Proposal, evidence: PoseEvidence, model: Model | None = None) -> list[str]:
    """Return the names of the available pieces of evidence, sorted by how far the log-odds of each are below their best
    value, the farthest first."""
    return (model or Model.load()).shortfalls(evidence_of(proposal, evidence))


def probability(proposal: Proposal, evidence: PoseEvidence, prior: float = 0.5, model: Model | None = None) -> float:
    """Return the probability in (0, 1) that a pose is correct.

    Args:
        proposal: the proposal, with the refined pose.
        evidence: the evidence under the refined pose.
        prior: share of evaluated poses that are correct, before any evidence.
    """
    return (model or Model.load()).probability(evidence_of(proposal, evidence), prior)

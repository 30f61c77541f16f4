"""How probable it is that a pose is right, of all its evidence together.

An additive model over log-odds: every piece of evidence is worth so much for or against, by a piecewise linear curve
that only rises (or only falls) with it, and the sum passes through a logistic. The curves are fitted by
``tools/fit/verdict.py`` on made places, with every fault that people's captures have, and stored beside this file; no
real capture had a part in it.
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
    """The fitted curves of each piece of evidence of `evidence_of`."""

    @classmethod
    def load(cls) -> Model:
        """The model that gsmap comes with."""
        return _shipped()


@lru_cache(maxsize=1)
def _shipped() -> Model:
    return Model.of_json((files("gsmap.register") / _FILE).read_text())


def evidence_of(proposal: Proposal, evidence: PoseEvidence) -> dict[str, float]:
    """The pieces of evidence that have a curve, each such that one step of it means about the same everywhere.

    NaN where one could not be had.
    """
    through_cameras = evidence.num_seen > 0
    nfa = proposal.log_nfa
    return {
        # Chance makes cliques of ten to some power; beyond what any capture needs nothing is won.
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
    """Log-odds that each piece of evidence adds, by its name."""
    return (model or Model.load()).worth(evidence_of(proposal, evidence))


def shortfalls(proposal: Proposal, evidence: PoseEvidence, model: Model | None = None) -> list[str]:
    """The names of the evidence that could be had, what lacks most of what it could be worth first."""
    return (model or Model.load()).shortfalls(evidence_of(proposal, evidence))


def probability(proposal: Proposal, evidence: PoseEvidence, prior: float = 0.5, model: Model | None = None) -> float:
    """How probable it is that a pose is right, in (0, 1).

    Args:
        proposal: with the refined pose.
        evidence: under that pose.
        prior: share of judged poses that are right before anything is known of them.
    """
    return (model or Model.load()).probability(evidence_of(proposal, evidence), prior)

"""How probable it is that a pose is right, of all its evidence together.

An additive model over log-odds: every piece of evidence is worth so much for or against, by a piecewise linear curve
that only rises (or only falls) with it, and the sum passes through a logistic. The curves are fitted by
``tools/fit_verdict.py`` on made places, with every fault that people's captures have, and stored beside this file; no
real capture had a part in it.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files

import numpy as np

from gsmap.register.evidence import PoseEvidence
from gsmap.types.registration import Proposal

VERSION = 1

_FILE = "probability.json"


@dataclass(frozen=True)
class Curve:
    """What one piece of evidence is worth.

    Args:
        knots: values of the evidence, rising.
        worth: log-odds at each knot; straight between, constant beyond.
        missing: log-odds where the evidence could not be had.
    """

    knots: tuple[float, ...]
    worth: tuple[float, ...]
    missing: float

    def at(self, value: float) -> float:
        """Log-odds for the pose (below 0: against it)."""
        return self.missing if np.isnan(value) else float(np.interp(value, self.knots, self.worth))


@dataclass(frozen=True)
class Model:
    """The fitted curves by the name of their evidence, and what none of them explains.

    Args:
        curves: of each piece of evidence of `evidence_of`.
        base: log-odds before any evidence, where a right pose is as frequent as a wrong one.
        least: probabilities lower than this, and higher than one minus it, were never seen often enough to be told
            apart: the answer stays within.
    """

    curves: dict[str, Curve]
    base: float
    least: float

    @classmethod
    def load(cls) -> Model:
        """The model that gsmap comes with."""
        return _shipped()


@lru_cache(maxsize=1)
def _shipped() -> Model:
    stored = json.loads((files("gsmap.register") / _FILE).read_text())
    curves = {name: Curve(tuple(c["knots"]), tuple(c["worth"]), c["missing"]) for name, c in stored["curves"].items()}
    return Model(curves, stored["base"], stored["least"])


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
    model = model or Model.load()
    return {name: model.curves[name].at(value) for name, value in evidence_of(proposal, evidence).items()}


def shortfalls(proposal: Proposal, evidence: PoseEvidence, model: Model | None = None) -> list[str]:
    """The names of the evidence that could be had, what lacks most of what it could be worth first."""
    model, lacks = model or Model.load(), {}
    for name, value in evidence_of(proposal, evidence).items():
        if not np.isnan(value):
            lacks[name] = max(model.curves[name].worth) - model.curves[name].at(value)
    return sorted(lacks, key=lambda name: -lacks[name])


def probability(proposal: Proposal, evidence: PoseEvidence, prior: float = 0.5, model: Model | None = None) -> float:
    """How probable it is that a pose is right, in (0, 1).

    Args:
        proposal: with the refined pose.
        evidence: under that pose.
        prior: share of judged poses that are right before anything is known of them.
    """
    model = model or Model.load()
    odds = model.base + np.log(prior / (1 - prior)) + sum(worth(proposal, evidence, model).values())
    return float(np.clip(1 / (1 + np.exp(-odds)), model.least, 1 - model.least))

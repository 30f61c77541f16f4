"""One probability of many pieces of evidence: an additive model over log-odds.

Every piece is worth so much for or against, by a piecewise linear curve, and the sum passes through a logistic. Curves
are fitted on made places by tools, and stored beside the room that asks them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np


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
        """Log-odds for what is judged (below 0: against it)."""
        return self.missing if np.isnan(value) else float(np.interp(value, self.knots, self.worth))


@dataclass(frozen=True)
class Odds:
    """The fitted curves by the name of their evidence, and what none of them explains.

    Args:
        curves: of each piece of evidence.
        base: log-odds before any evidence, where right is as frequent as wrong.
        least: probabilities lower than this, and higher than one minus it, were never seen often enough to be told
            apart: the answer stays within.
    """

    curves: dict[str, Curve]
    base: float
    least: float

    @classmethod
    def of_json(cls, text: str) -> Self:
        """From what `to_json` wrote."""
        return cls.of_stored(json.loads(text))

    @classmethod
    def of_stored(cls, stored: Mapping[str, Any]) -> Self:
        """From what was written as JSON among other things."""
        curves = {
            name: Curve(tuple(c["knots"]), tuple(c["worth"]), c["missing"]) for name, c in stored["curves"].items()
        }
        return cls(curves, stored["base"], stored["least"])

    def worth(self, evidence: Mapping[str, float]) -> dict[str, float]:
        """Log-odds that each piece adds, by its name."""
        return {name: self.curves[name].at(value) for name, value in evidence.items()}

    def shortfalls(self, evidence: Mapping[str, float]) -> list[str]:
        """The names of the evidence that could be had, what lacks most of what it could be worth first."""
        lacks = {}
        for name, value in evidence.items():
            if not np.isnan(value):
                lacks[name] = max(self.curves[name].worth) - self.curves[name].at(value)
        return sorted(lacks, key=lambda name: -lacks[name])

    def probability(self, evidence: Mapping[str, float], prior: float) -> float:
        """How probable it is, in (0, 1).

        Args:
            prior: share of what is judged that is right before anything is known of it.
        """
        odds = self.log_odds(evidence) + np.log(prior / (1 - prior))
        return float(np.clip(1 / (1 + np.exp(-odds)), self.least, 1 - self.least))

    def log_odds(self, evidence: Mapping[str, float], *, at_best: bool = False) -> float:
        """Of what is judged, where right is as frequent as wrong.

        Args:
            at_best: what is not named is as good as can be, else it is worth nothing.
        """
        rest = sum(max(curve.worth) for name, curve in self.curves.items() if name not in evidence) if at_best else 0.0
        return self.base + sum(self.worth(evidence).values()) + rest

"""Compute the probability of a hypothesis from several pieces of evidence by an additive log-odds model.

A piecewise linear curve gives the log-odds that each piece of evidence adds; a logistic function converts the sum to a
probability. The tools in ``tools/fit`` fit the curves on synthetic places; curves are stored beside the module that
uses them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np


@dataclass(frozen=True)
class Curve:
    """Piecewise linear log-odds curve of one piece of evidence.

    Args:
        knots: values of the evidence, increasing.
        worth: log-odds at each knot; linear between knots, constant beyond the outermost.
        missing: log-odds if the evidence is missing.
    """

    knots: tuple[float, ...]
    worth: tuple[float, ...]
    missing: float

    def at(self, value: float) -> float:
        """Return the log-odds of a value; NaN stands for missing evidence."""
        return self.missing if np.isnan(value) else float(np.interp(value, self.knots, self.worth))


@dataclass(frozen=True)
class Odds:
    """Fitted log-odds model.

    Args:
        curves: curves by the name of the evidence.
        base: log-odds without evidence, at a prior of one half.
        least: lowest probability, and one minus the highest; more extreme probabilities could not be calibrated.
    """

    curves: dict[str, Curve]
    base: float
    least: float

    @classmethod
    def of_json(cls, text: str) -> Self:
        """Load a model from JSON text."""
        return cls.of_stored(json.loads(text))

    @classmethod
    def of_stored(cls, stored: Mapping[str, Any]) -> Self:
        """Load a model from parsed JSON."""
        curves = {
            name: Curve(tuple(c["knots"]), tuple(c["worth"]), c["missing"]) for name, c in stored["curves"].items()
        }
        return cls(curves, stored["base"], stored["least"])

    def worth(self, evidence: Mapping[str, float]) -> dict[str, float]:
        """Return the log-odds that each piece of evidence adds, by the name of the piece."""
        return {name: self.curves[name].at(value) for name, value in evidence.items()}

    def shortfalls(self, evidence: Mapping[str, float]) -> list[str]:
        """Return the names of the present pieces of evidence, sorted by how far the log-odds of each are below their
        best value, the farthest first."""
        lacks = {}
        for name, value in evidence.items():
            if not np.isnan(value):
                lacks[name] = max(self.curves[name].worth) - self.curves[name].at(value)
        return sorted(lacks, key=lambda name: -lacks[name])

    def probability(self, evidence: Mapping[str, float], prior: float) -> float:
        """Return the probability of the hypothesis, in (0, 1).

        Args:
            prior: probability without evidence.
        """
        odds = self.log_odds(evidence) + np.log(prior / (1 - prior))
        return float(np.clip(1 / (1 + np.exp(-odds)), self.least, 1 - self.least))

    def log_odds(self, evidence: Mapping[str, float], *, at_best: bool = False) -> float:
        """Return the log-odds of the hypothesis at a prior of one half.

        Args:
            at_best: missing pieces of evidence count at their best value; by default they add nothing.
        """
        rest = sum(max(curve.worth) for name, curve in self.curves.items() if name not in evidence) if at_best else 0.0
        return self.base + sum(self.worth(evidence).values()) + rest

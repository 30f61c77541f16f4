"""Probability of a detected change, from its evidence.

Weights are fitted by ``tools/fit/change.py`` on synthetic places that changed, and on places that were captured again
unchanged, by night or with another exposure.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np

_MANY = 200  # cells; more prove nothing more
_OFTEN = 6  # views of each cell; more prove nothing more

BASES = {"looked through": -4.99, "painted": -4.03}
WEIGHTS = {
    "looked through": {"cells": 0.38, "views": 4.2, "on": -1.27, "slender": -5.3},
    "painted": {"cells": 0.85, "colour": 0.39},
}
"""Log-odds without evidence, and the weight of each of the `pieces`, at a prior of one half."""


def pieces(evidence: Mapping[str, float]) -> tuple[Literal["looked through", "painted"], dict[str, float]]:
    """Compute the features of the log-odds of a change.

    Args:
        evidence: of `gsmap.types.change.Change`.

    Returns:
        ``looked through`` if a part lies in free space of the other capture, ``painted`` if only colours differ; and
        the features by name.
    """
    if evidence["looked_through"] > 0:
        return "looked through", {
            "cells": float(np.log1p(min(evidence["looked_through"], _MANY))),
            "views": float(np.log1p(min(evidence["views_through"], _OFTEN))),
            "on": float(np.log1p(min(evidence["views_on"], _OFTEN))),
            "slender": evidence["slender"],
        }
    return "painted", {
        "cells": float(np.log1p(min(evidence["cells"], _MANY))),
        "colour": min(evidence["strength"], 8.0),
    }


def confidence(evidence: Mapping[str, float]) -> float:
    """Return the probability in (0, 1) of a change, at a prior of one half."""
    way, numbers = pieces(evidence)
    odds = BASES[way] + sum(WEIGHTS[way][name] * value for name, value in numbers.items())
    return float(1 / (1 + np.exp(-odds)))

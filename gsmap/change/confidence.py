"""Compute the probability of a detected change from its evidence.

``tools/fit/change.py`` fits the weights on synthetic places that changed, and on places that were captured again
unchanged, by night, with another exposure, blurred, with few photos or few training steps.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np

_MANY = 200  # number of cells beyond which further cells add no evidence
_OFTEN = 6  # number of views of each cell beyond which further views add no evidence
_DIFFERENT = 1.2  # difference of appearance, relative to the smallest that counts, from which on captures are not alike

BASES = {"looked through": -4.99, "painted": -4.03}
WEIGHTS = {
    "looked through": {"cells": 0.38, "views": 4.2, "on": -1.27, "slender": -5.3, "alike": -4.32},
    "painted": {"cells": 0.85, "colour": 0.39},
}
"""Log-odds without evidence, and the weight of each feature in `pieces`, at a prior of one half."""


def pieces(evidence: Mapping[str, float]) -> tuple[Literal["looked through", "painted"], dict[str, float]]:
    """Compute the features of the log-odds of a change.

    Args:
        evidence: evidence of a `gsmap.types.change.Change`.

    Returns:
        ``looked through`` if a part of the change lies in free space of the other capture, or ``painted`` if only
        colours differ; and the features by name.
    """
    if evidence["looked_through"] > 0:
        return "looked through", {
            "cells": float(np.log1p(min(evidence["looked_through"], _MANY))),
            "views": float(np.log1p(min(evidence["views_through"], _OFTEN))),
            "on": float(np.log1p(min(evidence["views_on"], _OFTEN))),
            "slender": evidence["slender"],
            "alike": max(_DIFFERENT - evidence["appearance"], 0.0),
        }
    return "painted", {
        "cells": float(np.log1p(min(evidence["cells"], _MANY))),
        "colour": min(evidence["strength"], 8.0),
    }


def confidence(evidence: Mapping[str, float]) -> float:
    """Return the probability, in (0, 1), that a change is real, at a prior of one half."""
    way, numbers = pieces(evidence)
    odds = BASES[way] + sum(WEIGHTS[way][name] * value for name, value in numbers.items())
    return float(1 / (1 + np.exp(-odds)))

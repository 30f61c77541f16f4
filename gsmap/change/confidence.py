"""How probable it is that a change is one, by what speaks for it.

Weights are fitted by ``tools/fit_change.py`` on made places that changed, and on others that were only seen again, by
night or with another exposure.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np

_MANY = 200  # cells, and
_OFTEN = 6  # views of each, more of which prove nothing more

BASES = {"looked through": -4.99, "painted": -4.03}
WEIGHTS = {
    "looked through": {"cells": 0.38, "views": 4.2, "on": -1.27, "slender": -5.3},
    "painted": {"cells": 0.85, "colour": 0.39},
}
"""Log-odds before any evidence, and what each of the `pieces` adds; right and wrong alike frequent."""


def pieces(evidence: Mapping[str, float]) -> tuple[Literal["looked through", "painted"], dict[str, float]]:
    """What speaks for a change, as numbers that add up.

    Args:
        evidence: of `gsmap.types.change.Change`.

    Returns:
        Whether any of it was looked through, or all was seen in another colour; and the numbers by name.
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
    """Probability in (0, 1) that something changed there, where as many candidates are right as are wrong."""
    way, numbers = pieces(evidence)
    odds = BASES[way] + sum(WEIGHTS[way][name] * value for name, value in numbers.items())
    return float(1 / (1 + np.exp(-odds)))

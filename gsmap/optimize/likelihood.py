"""Odds that an edge is wrong, against those of another edge that it contradicts, by the evidence of registration.

A repeated facade agrees with itself wherever it is laid, so disagreement alone misleads: less disagrees of a front laid
along itself than of a place that two captures see from afar and share a third of. But a right pose of much overlap
leaves next to nothing in front of free space, and its colours agree closely. The log-odds are linear in the figures; a
constant that all edges of a map share (how noisy its captures are) cancels where the edges of one loop are compared.

Weights: conditional logistic regression of wrong against right poses of the same map, on made street fronts with
exposure, bent and noisy geometry and floaters (``tools/bench/front.py --fit``). The number of false alarms has no part
in it: a repeated facade violates the independence that it assumes, and nothing corrects it for self-similarity.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

COLOUR, DISAGREEMENT, FREE_SPACE, OVERLAP = 1.0, 1.7, 2.4, 1.6
"""Weights of the figures of `features`, natural log-odds."""

_LEAST, _LEAST_COLOUR = 0.003, 0.02  # shares below these are noise of rendering


def features(evidence: Mapping[str, float], overlap: float) -> np.ndarray:
    """(4,) figures that each rise with the odds that a pose is wrong; NaN where no cameras could judge.

    Args:
        evidence: of the registration, by name (`gsmap.types.Registration`).
        overlap: share of surface cells that coincide under the pose, the smaller of both directions.
    """
    colour, disagreement, free_space = (
        evidence.get(name, float("nan")) for name in ("colour_correlation", "disagreement", "free_space_violation")
    )
    logs = np.log([1 - colour + _LEAST_COLOUR, disagreement + _LEAST, free_space + _LEAST])
    return np.r_[logs, overlap]


def log_odds_wrong(evidence: Mapping[str, float], overlap: float) -> float:
    """Natural log-odds that a pose is wrong, up to a constant that all edges share; NaN where no cameras could judge.

    Args:
        evidence, overlap: as in `features`.
    """
    return float(features(evidence, overlap) @ [COLOUR, DISAGREEMENT, FREE_SPACE, OVERLAP])

"""Compute the log-odds that an edge is wrong, rather than another edge that it contradicts, from the evidence of
registration.

A repeated facade agrees with itself under any shift by a period, so disagreement alone misleads: a shifted facade
disagrees less than two captures that see one place from afar and overlap by a third. But a correct pose with a large
overlap has nearly no surface in free space, and its colours agree closely. The log-odds are linear in the features
below. A constant that all edges of a map share (the noise of its captures) cancels when the edges of one loop are
compared.

The weights come from a conditional logistic regression of wrong against correct poses of the same map, on synthetic
street facades with varying exposure, distorted and noisy geometry and floaters (``tools/bench/front.py --fit``). A
repeated facade violates the independence that the number of false alarms assumes, so a pose whose correspondences are
significant gains nothing from still fewer false alarms. But a pose whose correspondences chance may explain is wrong
with about that probability.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

COLOUR, DISAGREEMENT, FREE_SPACE, OVERLAP = 1.0, 1.7, 2.4, 1.6
"""Weights of the features of `features` but the last, whose weight is 1, in natural log-odds."""

_SIGNIFICANT_LOG_NFA = -8.0  # log10 of the number of false alarms from which correspondences are significant

_LEAST, _LEAST_COLOUR = 0.003, 0.02  # smaller shares are noise of rendering


def features(evidence: Mapping[str, float], overlap: float) -> np.ndarray:
    """Compute 5 features that rise with the odds that a pose is wrong; NaN if no camera observed the common surface.

    Args:
        evidence: evidence of the registration, by name (`gsmap.types.Registration`).
        overlap: share of surface cells that coincide under the pose; the smaller of both directions.
    """
    colour, disagreement, free_space = (
        evidence.get(name, float("nan")) for name in ("colour_correlation", "disagreement", "free_space_violation")
    )
    logs = np.log([1 - colour + _LEAST_COLOUR, disagreement + _LEAST, free_space + _LEAST])
    log_nfa = evidence.get("log_nfa", float("nan"))
    known = _SIGNIFICANT_LOG_NFA if np.isnan(log_nfa) else np.clip(log_nfa, _SIGNIFICANT_LOG_NFA, 0.0)
    return np.r_[logs, overlap, known * np.log(10)]


def log_odds_wrong(evidence: Mapping[str, float], overlap: float) -> float:
    """Compute the log-odds that a pose is wrong, up to a constant that all edges share; NaN if no camera observed the
    common surface.

    Args:
        evidence, overlap: as in `features`.
    """
    return float(features(evidence, overlap) @ [COLOUR, DISAGREEMENT, FREE_SPACE, OVERLAP, 1.0])

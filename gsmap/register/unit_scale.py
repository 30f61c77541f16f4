"""Decide whether the scale between two scenes that may both be in metres is exactly 1."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

DRIFT_SIGMA = 0.02  # of the log scale between two scenes in metres: phones and SLAM drift by one to three percent
RIGID_ODDS = 3.0  # prior odds that the scale is exactly 1
_MAX_DISAGREEMENT_SIGMAS = 5.0  # from a scale of 1; beyond it two scenes specified in metres get a message
# A capture counts as bent if its log scale is off by more than this many standard deviations of the residuals and by
# more than this value.
_MIN_BEND_SIGMAS = 3.0
_MIN_BEND = 0.002


@dataclass(frozen=True)
class ScaleDecision:
    """The decision on the scale of a pose: exactly 1 or the measured scale.

    Args:
        rigid: the scale is 1.
        log_scale: logarithm of the measured scale.
        measured_sigma: standard deviation of the measurement.
        log_scale_sigma: standard deviation of the decided scale.
        note: message for the user, or empty.
    """

    rigid: bool
    log_scale: float
    measured_sigma: float
    log_scale_sigma: float
    note: str = ""


def decide_scale(log_scale: float, sigma: float, *, specified: bool = False) -> ScaleDecision:
    """Decide between a scale of 1 and a measured one by a Bayesian test of two hypotheses.

    The measurement is ``N(log scale, sigma^2)``, and the log scale is 0 or ``N(0, DRIFT_SIGMA^2)``. The likelihood
    ratio with prior odds `RIGID_ODDS` decides, so for a scale of 1 a precise measurement must be nearer to 1 than an
    imprecise one, but may be more standard deviations off. A scale of 1 gets the root mean square of the drift's
    posterior as its standard deviation.

    Args:
        log_scale, sigma: the measured log scale and its standard deviation.
        specified: both scenes are specified to be in metres; the scale is 1 whatever is measured.
    """
    off = abs(log_scale) / sigma
    weight = DRIFT_SIGMA**2 / (DRIFT_SIGMA**2 + sigma**2)
    log_odds = np.log(RIGID_ODDS) + 0.5 * np.log1p((DRIFT_SIGMA / sigma) ** 2) - 0.5 * weight * off**2
    if not specified and log_odds < 0:
        return ScaleDecision(False, log_scale, sigma, sigma)
    log_scale_sigma = float(np.sqrt(weight * sigma**2 + (weight * log_scale) ** 2))
    note = ""
    if off > _MAX_DISAGREEMENT_SIGMAS:
        note = (
            f"both scenes are specified to be in metres, but their surfaces differ in scale by "
            f"{np.expm1(log_scale):+.2%} ({off:.0f} sigma): check both units"
        )
    return ScaleDecision(True, log_scale, sigma, log_scale_sigma, note)


def bending_note(decision: ScaleDecision, residual_sigma: float, extent_m: float) -> str:
    """Return a message about surfaces in metres whose measured scale differs from 1 by more than residuals explain.

    Args:
        residual_sigma: standard deviation of the log scale by the residuals alone.
        extent_m: size of the overlap.

    Returns:
        The message; empty where residuals explain the difference or the scale is not 1.
    """
    off = abs(decision.log_scale)
    if decision.note or not decision.rigid or off < max(_MIN_BEND_SIGMAS * residual_sigma, _MIN_BEND):
        return ""
    return (
        "one capture is bent, or its metric scale drifts: the source's lengths differ by "
        f"{np.expm1(-decision.log_scale):+.1%} "
        f"over {extent_m:.1f} m, {off / residual_sigma:.0f} times the error that the residuals explain"
    )

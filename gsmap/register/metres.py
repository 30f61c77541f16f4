"""What a measured scale says of two sources that may both be in metres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

DRIFT_SIGMA = 0.02  # of the log scale between two sources in metres that drift: phones and SLAM by one to three percent
RIGID_ODDS = 3.0  # prior odds that the scale is exactly 1
_MAX_DISAGREEMENT_SIGMAS = 5.0  # from 1; two sources specified in metres that differ by more are noted
# Surfaces whose scale is off by more than this many standard deviations of the residuals, and by this log scale, bend.
_MIN_BEND_SIGMAS = 3.0
_MIN_BEND = 0.002


@dataclass(frozen=True)
class Belief:
    """The scale between two sources after it was measured.

    Args:
        rigid: the scale is taken for 1.
        log_scale: the measured one ...
        measured_sigma: ... and its standard deviation.
        log_scale_sigma: standard deviation of the scale that is taken.
        note: what a person should know, or empty.
    """

    rigid: bool
    log_scale: float
    measured_sigma: float
    log_scale_sigma: float
    note: str = ""


def believe(log_scale: float, sigma: float, *, told: bool = False) -> Belief:
    """Whether a measured log scale is 1 or what was measured, and how sure that is.

    The measurement is ``N(log scale, sigma^2)``, and the log scale 0 or ``N(0, drift_sigma^2)``: it is taken for 0
    where that is the more probable (two hypotheses, by their likelihoods and ``rigid_odds``), so that what
    is measured well must be nearer to 1, but may be more sigmas off, than what is not.

    How sure a scale of 1 is, is the root mean square of what Bayes' rule makes of a drift and the measurement: of a
    scale that the surfaces do not fix no more is known than that metres drift. What was ``told`` is taken whatever is
    measured, and its standard deviation then says how far that is from the measurement.
    """
    off = abs(log_scale) / sigma
    weight = DRIFT_SIGMA**2 / (DRIFT_SIGMA**2 + sigma**2)
    log_odds = np.log(RIGID_ODDS) + 0.5 * np.log1p((DRIFT_SIGMA / sigma) ** 2) - 0.5 * weight * off**2
    if not told and log_odds < 0:
        return Belief(False, log_scale, sigma, sigma)
    log_scale_sigma = float(np.sqrt(weight * sigma**2 + (weight * log_scale) ** 2))
    note = ""
    if off > _MAX_DISAGREEMENT_SIGMAS:
        note = (
            f"both sources are said to be in metres, and their surfaces differ by {np.expm1(log_scale):+.2%} "
            f"({off:.0f} sigma): check one's unit"
        )
    return Belief(True, log_scale, sigma, log_scale_sigma, note)


def bending(belief: Belief, residual_sigma: float, extent_m: float) -> str:
    """What a person should know of surfaces that fit as well as residuals can tell, but measure another size than the
    metres that both are taken to be in; empty where residuals explain it, or the scale is believed to differ.

    Args:
        residual_sigma: standard deviation of the log scale as far as residuals show errors.
        extent_m: over which the surfaces overlap.
    """
    off = abs(belief.log_scale)
    if belief.note or not belief.rigid or off < max(_MIN_BEND_SIGMAS * residual_sigma, _MIN_BEND):
        return ""
    return (
        f"one capture bends, or its metre drifts: the source measures {np.expm1(-belief.log_scale):+.1%} over "
        f"{extent_m:.1f} m, {off / residual_sigma:.0f} times what its residuals explain"
    )

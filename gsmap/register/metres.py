"""What a measured scale says of two sources that may both be in metres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Params:
    """What is believed of sources that may be in metres.

    Args:
        drift_sigma: log scale by which two such sources differ, if they do: metres of phones and of SLAM drift by one
            to three percent.
        rigid_odds: how many times as probable it is, before it is measured, that they do not.
        disagree_sigmas: two sources that were told to be in metres and measure further from 1 than this are noted.
        bend_sigmas: surfaces that are taken for metres and measure further from 1 than this many times what their
            residuals explain are bent, which is noted ...
        least_bend: ... from this log scale on.
    """

    drift_sigma: float = 0.02
    rigid_odds: float = 3.0
    disagree_sigmas: float = 5.0
    bend_sigmas: float = 3.0
    least_bend: float = 0.002


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


def believe(log_scale: float, sigma: float, params: Params | None = None, *, told: bool = False) -> Belief:
    """Whether a measured log scale is 1 or what was measured, and how sure that is.

    The measurement is ``N(log scale, sigma^2)``, and the log scale 0 or ``N(0, drift_sigma^2)``: it is taken for 0
    where that is the more probable (two hypotheses, by their likelihoods and ``rigid_odds``), so that what
    is measured well must be nearer to 1, but may be more sigmas off, than what is not.

    How sure a scale of 1 is, is the root mean square of what Bayes' rule makes of a drift and the measurement: of a
    scale that the surfaces do not fix no more is known than that metres drift. What was ``told`` is taken whatever is
    measured, and its standard deviation then says how far that is from the measurement.
    """
    params = params or Params()
    off = abs(log_scale) / sigma
    weight = params.drift_sigma**2 / (params.drift_sigma**2 + sigma**2)
    log_odds = np.log(params.rigid_odds) + 0.5 * np.log1p((params.drift_sigma / sigma) ** 2) - 0.5 * weight * off**2
    if not told and log_odds < 0:
        return Belief(False, log_scale, sigma, sigma)
    log_scale_sigma = float(np.sqrt(weight * sigma**2 + (weight * log_scale) ** 2))
    note = ""
    if off > params.disagree_sigmas:
        note = (
            f"both sources are said to be in metres, and their surfaces differ by {np.expm1(log_scale):+.2%} "
            f"({off:.0f} sigma): check one's unit"
        )
    return Belief(True, log_scale, sigma, log_scale_sigma, note)


def bending(belief: Belief, residual_sigma: float, extent_m: float, params: Params | None = None) -> str:
    """What a person should know of surfaces that fit as well as residuals can tell, but measure another size than the
    metres that both are taken to be in; empty where residuals explain it, or the scale is believed to differ.

    Args:
        residual_sigma: standard deviation of the log scale as far as residuals show errors.
        extent_m: over which the surfaces overlap.
    """
    params = params or Params()
    off = abs(belief.log_scale)
    if belief.note or not belief.rigid or off < max(params.bend_sigmas * residual_sigma, params.least_bend):
        return ""
    return (
        f"one capture bends, or its metre drifts: the source measures {np.expm1(-belief.log_scale):+.1%} over "
        f"{extent_m:.1f} m, {off / residual_sigma:.0f} times what its residuals explain"
    )

"""Accept a pose, or say why not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.register.agreement import Agreement
from gsmap.register.propose import Proposal


@dataclass(frozen=True)
class Params:
    """Bars a pose must clear; a wrong edge costs a map more than ten right ones missed.

    Measured on 28 pairs of real captures and 39 of made ones, after refinement, right poses against every proposal for
    pairs apart and the best of random ones laid floor on floor. Right poses contradict by at most 0.005 (a house),
    0.014 (a kitchen by a real sensor), 0.061 (made places, whose doors were shut between captures) and 0.13 (through
    synthesised cameras); colours correlate by at least 0.76, 0.27 and 0.56. Of the wrong ones, those that contradict by
    up to 0.1 all have a correlation below 0.01; those that correlate by 0.1 or more contradict by 0.19 or more. The
    kitchen laid on itself 10 deg and 18 cm off correlates as well as the truth, but contradicts by 0.05. The bars stand
    in the middle of these gaps.

    Args:
        max_log_nfa, max_runner_up: a clique is significant when fewer false alarms than this (log10) are expected and
            no disagreeing clique comes nearer than this share of it. Rooms furnished alike repeat whole arrangements,
            which chance does not know of: measured down to -7 between different made places, so the bar is lower.
        min_coinciding: source cells that must coincide with the target's surface.
        max_contradiction: share of a scene's surface in front of what the other scene's cameras saw.
        min_colour_correlation, min_colour_t: local colours of both scenes' renders must agree this well, this surely.
        changed_contradiction, changed_colour_correlation: places change (a door that was open is shut), so more
            contradiction is borne where colours agree this well.
        strong_overlap, strong_contradiction, strong_colour_correlation, strong_colour_t: what the scenes must show to
            carry a pose whose clique is not significant, or that came from no clique, to the cameras of both; where
            colours agree as well as in a place that changed, ``max_contradiction`` will do.
        hopeless_colour_correlation, hopeless_colour_t, hopeless_contradiction: a rough pose that shows less, or
            contradicts more, is not worth refining further.
        max_rotation_sigma_deg, max_translation_sigma_m, max_scale_sigma: a pose known less well (standard deviation in
            the least known direction, at the overlap's centroid) is not an edge.
    """

    max_log_nfa: float = -8.0
    max_runner_up: float = 0.7
    min_coinciding: int = 300
    max_contradiction: float = 0.08
    min_colour_correlation: float = 0.15
    min_colour_t: float = 3.0
    changed_contradiction: float = 0.18
    changed_colour_correlation: float = 0.55
    strong_overlap: float = 0.10
    strong_contradiction: float = 0.025
    strong_colour_correlation: float = 0.20
    strong_colour_t: float = 4.0
    hopeless_colour_correlation: float = 0.05
    hopeless_colour_t: float = 1.5
    hopeless_contradiction: float = 0.3
    max_rotation_sigma_deg: float = 1.5
    max_translation_sigma_m: float = 0.05
    max_scale_sigma: float = 0.025


def is_significant(proposal: Proposal, params: Params | None = None) -> bool:
    """The correspondences alone rule out chance, and no rival pose comes near."""
    params = params or Params()
    return bool(proposal.log_nfa < params.max_log_nfa and proposal.runner_up <= params.max_runner_up)


def hopeless(agreement: Agreement, params: Params | None = None) -> str:
    """Why a roughly refined pose cannot come to be accepted; empty while it may."""
    params = params or Params()
    colours = agreement.colour_correlation < params.hopeless_colour_correlation
    if agreement.num_coinciding < 50 or (colours and agreement.colour_t < params.hopeless_colour_t):
        return f"colours disagree where surfaces coincide (correlation {agreement.colour_correlation:.2f})"
    if agreement.contradiction > params.hopeless_contradiction:
        return f"{agreement.contradiction:.0%} of the surface seen contradicts what cameras saw"
    return ""


def judge(
    proposal: Proposal,
    agreement: Agreement,
    sigmas: tuple[float, float, float] | None,
    params: Params | None = None,
) -> str:
    """Empty when the pose is accepted, else the reason why not.

    Args:
        agreement: what the surfaces say under the refined pose.
        sigmas: standard deviations (rad, metres, log scale) of the least known directions; None without overlap.
    """
    params = params or Params()
    if proposal.flaw:
        return proposal.flaw
    if agreement.num_coinciding < params.min_coinciding or sigmas is None:
        return f"too little surface coincides ({agreement.num_coinciding} cells)"
    if agreement.colour_correlation < params.min_colour_correlation or agreement.colour_t < params.min_colour_t:
        return f"colours disagree where surfaces coincide (correlation {agreement.colour_correlation:.2f})"
    changed = agreement.colour_correlation >= params.changed_colour_correlation
    if agreement.contradiction > (params.changed_contradiction if changed else params.max_contradiction):
        return f"{agreement.contradiction:.0%} of the surface seen contradicts what cameras saw"
    degrees = np.degrees(sigmas[0])
    if (
        degrees > params.max_rotation_sigma_deg
        or sigmas[1] > params.max_translation_sigma_m
        or sigmas[2] > params.max_scale_sigma
    ):
        return (
            f"the overlap fixes the pose only to {degrees:.1f} deg, {100 * sigmas[1]:.0f} cm, {sigmas[2]:.1%} in scale"
        )
    if is_significant(proposal, params):
        return ""
    strong = (
        agreement.num_seen > 0
        and agreement.overlap >= params.strong_overlap
        and agreement.contradiction <= (params.max_contradiction if changed else params.strong_contradiction)
        and agreement.colour_correlation >= params.strong_colour_correlation
        and agreement.colour_t >= params.strong_colour_t
    )
    if strong:
        return ""
    return "not significant: chance could explain the match, and the surfaces do not confirm it strongly enough"

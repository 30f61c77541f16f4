"""Accept a pose, or say why not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.register.evidence import PoseEvidence
from gsmap.types.registration import Proposal


@dataclass(frozen=True)
class Params:
    """Bars a pose must clear; a wrong edge costs a map more than ten right ones missed.

    Measured on 28 pairs of real captures and 39 of synthetic ones, after refinement, right poses against every proposal
    for pairs apart and the best of random ones laid floor on floor. Right poses violate free space by at most 0.005 (a
    house), 0.014 (a kitchen by a real sensor), 0.061 (synthetic scenes, whose doors were shut between captures) and
    0.13 (through synthesised cameras); colours correlate by at least 0.76, 0.27 and 0.56. Of the wrong ones, those that
    violate free space by up to 0.1 all have a correlation below 0.01; those that correlate by 0.1 or more violate it by
    0.19 or more. The kitchen laid on itself 10 deg and 18 cm off correlates as well as the truth, but violates free
    space by 0.05. The bars stand in the middle of these gaps.

    Args:
        max_log_nfa: a clique is significant when fewer false alarms than this (log10) are expected of the background
            model. Rooms furnished alike repeat whole arrangements, which violates the independence that it assumes:
            measured down to -7 between different synthetic scenes, so the bar is lower than the theory's -2.
        max_runner_up: ... and no disagreeing clique comes nearer to its size than this share of it.
        min_coinciding: source cells that must coincide with the target's surface.
        max_free_space_violation: share of a scene's surface in front of what the other scene's cameras saw.
        min_colour_correlation: local colours of both scenes' renders must agree this well ...
        min_colour_t: ... and this surely (standard deviations).
        changed_free_space_violation: places change (a door that was open is shut), so this much violation of free space
            is borne ...
        changed_colour_correlation: ... where colours agree this well.
        strong_overlap: share of the surface that must coincide to carry a pose whose clique is not significant, or that
            came from no clique; what was seen by the cameras of both must be as follows.
        strong_free_space_violation: the violation of free space that such a pose may show; where colours agree as well
            as in a place that changed, ``max_free_space_violation`` will do.
        strong_colour_correlation: the correlation of colours that such a pose needs.
        strong_colour_t: the significance of that correlation that such a pose needs.
        prescreen_min_coinciding: a rough pose under which fewer cells coincide is not worth refining further ...
        prescreen_colour_correlation: ... nor one whose colours agree less than this ...
        prescreen_colour_t: ... and less surely than this ...
        prescreen_free_space_violation: ... nor one that violates free space by more.
        max_rotation_sigma_deg: a pose whose rotation is known less well (standard deviation in the least known
            direction, at the overlap's centroid) is not an edge.
        max_translation_sigma_m: the same for translation.
        max_scale_sigma: the same for the logarithm of the scale.
    """

    max_log_nfa: float = -8.0
    max_runner_up: float = 0.7
    min_coinciding: int = 300
    max_free_space_violation: float = 0.08
    min_colour_correlation: float = 0.15
    min_colour_t: float = 3.0
    changed_free_space_violation: float = 0.18
    changed_colour_correlation: float = 0.55
    strong_overlap: float = 0.10
    strong_free_space_violation: float = 0.025
    strong_colour_correlation: float = 0.20
    strong_colour_t: float = 4.0
    prescreen_min_coinciding: int = 50
    prescreen_colour_correlation: float = 0.05
    prescreen_colour_t: float = 1.5
    prescreen_free_space_violation: float = 0.3
    max_rotation_sigma_deg: float = 1.5
    max_translation_sigma_m: float = 0.05
    max_scale_sigma: float = 0.025


def is_significant(proposal: Proposal, params: Params | None = None) -> bool:
    """The correspondences alone rule out the background model, and no rival pose comes near."""
    params = params or Params()
    return is_rare(proposal, params) and bool(proposal.runner_up <= params.max_runner_up)


def is_rare(proposal: Proposal, params: Params) -> bool:
    """The background model expects fewer false alarms than allowed; never where none were counted."""
    return bool(proposal.log_nfa < params.max_log_nfa)


def not_significant(proposal: Proposal, params: Params, besides: str = "") -> str:
    """Why the correspondences alone do not carry the pose; ``besides`` is what else there is to say."""
    if np.isnan(proposal.log_nfa):
        why = f"{proposal.proposer} counts no false alarms, log10 NFA needs < {params.max_log_nfa:.1f}"
    elif not is_rare(proposal, params):
        why = f"log10 NFA {proposal.log_nfa:.1f}, needs < {params.max_log_nfa:.1f}"
    else:
        why = f"a rival clique has {proposal.runner_up:.0%} of its size, allowed {params.max_runner_up:.0%}"
    if besides.startswith(_NOT_SIGNIFICANT):
        return besides
    return f"{_NOT_SIGNIFICANT}: {why}" + (f" ({besides})" if besides else "")


def fails_prescreen(evidence: PoseEvidence, params: Params | None = None) -> str:
    """Why a roughly refined pose cannot come to be accepted; empty while it may."""
    params = params or Params()
    if evidence.num_coinciding < params.prescreen_min_coinciding:
        return _too_little(evidence, params.prescreen_min_coinciding)
    pale = evidence.colour_correlation < params.prescreen_colour_correlation
    if pale and evidence.colour_t < params.prescreen_colour_t:
        return _colours_disagree(evidence, params.prescreen_colour_correlation, params.prescreen_colour_t)
    if evidence.free_space_violation > params.prescreen_free_space_violation:
        return _violates(evidence, params.prescreen_free_space_violation)
    return ""


def judge(
    proposal: Proposal,
    evidence: PoseEvidence,
    sigmas: tuple[float, float, float] | None,
    params: Params | None = None,
) -> str:
    """Empty when the pose is accepted, else the reason why not.

    Args:
        proposal: with the refined pose.
        evidence: under that pose.
        sigmas: standard deviations (rad, metres, log scale) of the least known directions; None without overlap.
    """
    params = params or Params()
    if proposal.flaw:
        return proposal.flaw
    if evidence.num_coinciding < params.min_coinciding or sigmas is None:
        return _too_little(evidence, params.min_coinciding)
    if evidence.colour_correlation < params.min_colour_correlation or evidence.colour_t < params.min_colour_t:
        return _colours_disagree(evidence, params.min_colour_correlation, params.min_colour_t)
    changed = evidence.colour_correlation >= params.changed_colour_correlation
    allowed = params.changed_free_space_violation if changed else params.max_free_space_violation
    if evidence.free_space_violation > allowed:
        return _violates(evidence, allowed)
    degrees = np.degrees(sigmas[0])
    if (
        degrees > params.max_rotation_sigma_deg
        or sigmas[1] > params.max_translation_sigma_m
        or sigmas[2] > params.max_scale_sigma
    ):
        return (
            f"the overlap fixes the pose only to {degrees:.1f} deg, {100 * sigmas[1]:.0f} cm, {sigmas[2]:.1%} in scale"
        )
    if is_significant(proposal, params) or _is_strong(evidence, params, changed):
        return ""
    return not_significant(proposal, params, "and the surfaces do not confirm it strongly enough")


def _is_strong(evidence: PoseEvidence, params: Params, changed: bool) -> bool:
    """The surfaces and the cameras of both carry the pose by themselves."""
    allowed = params.max_free_space_violation if changed else params.strong_free_space_violation
    return (
        evidence.num_seen > 0
        and evidence.overlap >= params.strong_overlap
        and evidence.free_space_violation <= allowed
        and evidence.colour_correlation >= params.strong_colour_correlation
        and evidence.colour_t >= params.strong_colour_t
    )


_NOT_SIGNIFICANT = "not significant"


def _too_little(evidence: PoseEvidence, needs: int) -> str:
    return f"too little surface coincides: {evidence.num_coinciding} cells, needs {needs}"


def _colours_disagree(evidence: PoseEvidence, correlation: float, t: float) -> str:
    return (
        f"colours disagree where surfaces coincide: correlation {evidence.colour_correlation:.2f}, needs "
        f"{correlation:.2f} (t {evidence.colour_t:.1f}, needs {t:.1f})"
    )


def _violates(evidence: PoseEvidence, allowed: float) -> str:
    return f"free-space violation {evidence.free_space_violation:.0%}, allowed {allowed:.0%}"

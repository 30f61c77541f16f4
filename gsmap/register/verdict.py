"""Accept a pose, or say why not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.register.evidence import PoseEvidence
from gsmap.register.probability import probability, shortfalls
from gsmap.types.registration import Proposal


@dataclass(frozen=True)
class Params:
    """What a pose must show; a wrong edge costs a map more than ten right ones missed, hence a probability of .9.

    How probable a pose is, of all its evidence, says `gsmap.register.probability`, fitted on made places. What one
    scene has where the other looked through contradicts a pose whatever speaks for it: two wings that look alike agree
    in everything else.

    Args:
        max_log_nfa: a clique is significant when fewer false alarms than this (log10) are expected of the background
            model. Rooms furnished alike repeat whole arrangements, which violates the independence that it assumes:
            measured down to -7 between different synthetic scenes, so the bar is lower than the theory's -2.
        max_runner_up: ... and no disagreeing clique comes nearer to its size than this share of it.
        min_coinciding: source cells that must coincide with the target's surface.
        max_free_space_violation: share of a scene's surface in front of what the other scene's cameras saw: places
            change (a door that was open is shut), but not by more [0, 1].
        free_space_level: a share that was measured on few Gaussians contradicts a pose only where so many of them would
            violate free space with less than this probability if the share were the allowed one (binomial test)
            (0, 0.5]; otherwise it counts in the probability alone. A smaller level lets more poses come so far.
        min_colour_correlation: local colours of both scenes' renders must agree this well: places are repainted, but
            not all of it.
        min_probability: that the pose is right, of all evidence together.
        prior: share of judged poses that are right before anything is known of them; most pairs that come so far do
            share a place, most pairs of a large map do not come so far.
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
    max_free_space_violation: float = 0.18
    free_space_level: float = 0.01
    min_colour_correlation: float = 0.15
    min_probability: float = 0.9
    prior: float = 0.2
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
        return _colours_disagree(evidence, params.prescreen_colour_correlation)
    if violates_free_space(
        evidence.free_space_violation, evidence.num_judged, params.prescreen_free_space_violation, params
    ):
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
    against = contradiction(proposal, evidence, params)
    if against or sigmas is None:
        return against or _too_little(evidence, params.min_coinciding)
    degrees = np.degrees(sigmas[0])
    if (
        degrees > params.max_rotation_sigma_deg
        or sigmas[1] > params.max_translation_sigma_m
        or sigmas[2] > params.max_scale_sigma
    ):
        return (
            f"the overlap fixes the pose only to {degrees:.1f} deg, {100 * sigmas[1]:.0f} cm, {sigmas[2]:.1%} in scale"
        )
    return improbable(proposal, evidence, params)


def contradiction(proposal: Proposal, evidence: PoseEvidence, params: Params) -> str:
    """What contradicts a pose whatever else speaks for it; empty where nothing does."""
    if proposal.flaw:
        return proposal.flaw
    if evidence.num_coinciding < params.min_coinciding:
        return _too_little(evidence, params.min_coinciding)
    if evidence.colour_correlation < params.min_colour_correlation:
        return _colours_disagree(evidence, params.min_colour_correlation)
    if violates_free_space(evidence.free_space_violation, evidence.num_judged, params.max_free_space_violation, params):
        return _violates(evidence, params.max_free_space_violation)
    return ""


def violates_free_space(share: float, num_judged: float, allowed: float, params: Params) -> bool:
    """Whether a share of Gaussians violates free space by more than is allowed, and than so few of them explain.

    Args:
        share: NaN where no cameras could judge.
        num_judged: Gaussians that it is of; 0 or NaN where that is not known.
    """
    from scipy.stats import binom

    if not share > allowed:
        return False
    return not num_judged > 0 or bool(
        binom.sf(round(share * num_judged) - 1, num_judged, allowed) < params.free_space_level
    )


def is_believable(proposal: Proposal, evidence: PoseEvidence, params: Params) -> bool:
    """Nothing contradicts the pose and all evidence together carries it, however well it is known."""
    return not contradiction(proposal, evidence, params) and not improbable(proposal, evidence, params)


def improbable(proposal: Proposal, evidence: PoseEvidence, params: Params) -> str:
    """Why all evidence together does not carry a pose; empty where it does."""
    probable = probability(proposal, evidence, params.prior)
    # Where the cameras of one scene could not judge, nothing was learnt of what a clique beyond chance is worth.
    if probable >= params.min_probability or (not evidence.num_seen and is_significant(proposal, params)):
        return ""
    return f"not probable enough: {probable:.1%}, needs {params.min_probability:.0%}: {_weakest(proposal, evidence)}"


def _weakest(proposal: Proposal, evidence: PoseEvidence) -> str:
    """The two pieces of evidence that a sure pose would show otherwise, in words."""
    words = {
        "log_nfa": f"chance explains the correspondences (log10 NFA {proposal.log_nfa:.1f})",
        "runner_up": f"a rival clique has {proposal.runner_up:.0%} of its size",
        "free_space_violation": f"free-space violation {evidence.free_space_violation:.0%}",
        "disagreement": f"{evidence.disagreement:.0%} of what both saw differs",
        "overlap": f"overlap {evidence.overlap:.0%}",
        "num_coinciding": f"{evidence.num_coinciding} cells coincide",
        "colour_correlation": f"colours disagree where surfaces coincide ({evidence.colour_correlation:.2f})",
        "colour_t": f"colours agree by {evidence.colour_t:.1f} standard deviations",
    }
    return ", ".join(words[name] for name in shortfalls(proposal, evidence)[:2])


_NOT_SIGNIFICANT = "not significant"


def _too_little(evidence: PoseEvidence, needs: int) -> str:
    return f"too little surface coincides: {evidence.num_coinciding} cells, needs {needs}"


def _colours_disagree(evidence: PoseEvidence, needs: float) -> str:
    correlation = f"{evidence.colour_correlation:.2f}"
    return f"colours disagree where surfaces coincide: correlation {correlation}, needs {needs:.2f}"


def _violates(evidence: PoseEvidence, allowed: float) -> str:
    return f"free-space violation {evidence.free_space_violation:.0%}, allowed {allowed:.0%}"

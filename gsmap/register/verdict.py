"""Accept or reject a pose by its evidence, with a reason."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.reason_codes import reason
from gsmap.register.evidence import PoseEvidence
from gsmap.register.probability import probability, shortfalls
from gsmap.settings.ranges import require_range
from gsmap.types.registration import Proposal

MAX_RUNNER_UP = 0.7  # with a larger rival clique (as a share of the best clique's size) a pose is not significant
# A free-space violation measured on few Gaussians contradicts a pose only if a binomial test rejects the allowed share:
# so many violations would have less than this probability.
_FREE_SPACE_LEVEL = 0.01
PRIOR = 0.2  # share of evaluated poses that are correct, before any evidence
# Thresholds of the prescreen of roughly refined poses.
PRESCREEN_LOG_NFA = 6.0  # a pose with a larger log10 NFA is not refined at all
PRESCREEN_CAMERAS = 3
PRESCREEN_POINTS = 4000
_PRESCREEN_MIN_COINCIDING = 50
_PRESCREEN_COLOUR_CORRELATION = 0.05
_PRESCREEN_COLOUR_T = 1.5
_PRESCREEN_FREE_SPACE_VIOLATION = 0.3


@dataclass(frozen=True)
class Params:
    """Thresholds for accepting a pose; one wrong edge costs a map more than ten missed correct edges.

    Args:
        max_log_nfa: Largest log10 of the number of false alarms (NFA) at which a clique counts as significant, at most
            0; a larger value accepts more poses (poses between different rooms with the same furniture reach -7).
        min_coinciding: Smallest number of source surface cells, at least 1, that must coincide with the target's
            surface; a larger value rejects small overlaps.
        max_free_space_violation: Largest fraction in [0, 1] of one scene's surface that may stand in the free space of
            the other; a larger value tolerates more change between captures.
        min_colour_correlation: Smallest correlation in [-1, 1] between the local colours of both scenes in renders; a
            larger value rejects more repainted places.
        min_probability: Smallest probability in [0, 1], given all evidence, that an accepted pose is correct; a larger
            value accepts fewer incorrect and fewer correct poses.
        max_rotation_sigma_deg: Largest standard deviation of the rotation, in degrees, positive, about its least
            certain axis at the overlap's centroid; a larger value accepts less certain poses.
        max_translation_sigma_m: Largest standard deviation of the translation, in metres, positive, in its least
            certain direction at the overlap's centroid; a larger value accepts less certain poses.
        max_scale_sigma: Largest standard deviation of the logarithm of the scale, positive; a larger value accepts less
            certain scales.
    """

    max_log_nfa: float = -8.0
    min_coinciding: int = 300
    max_free_space_violation: float = 0.18
    min_colour_correlation: float = 0.15
    min_probability: float = 0.9
    max_rotation_sigma_deg: float = 1.5
    max_translation_sigma_m: float = 0.05
    max_scale_sigma: float = 0.025

    def __post_init__(self) -> None:
        require_range(self, "[-inf, 0]", "max_log_nfa")
        require_range(self, "[1, inf]", "min_coinciding")
        require_range(self, "[0, 1]", "max_free_space_violation", "min_probability")
        require_range(self, "[-1, 1]", "min_colour_correlation")
        require_range(self, "(0, inf]", "max_rotation_sigma_deg", "max_translation_sigma_m", "max_scale_sigma")


def is_significant(proposal: Proposal, params: Params | None = None) -> bool:
    """Return whether chance does not explain the correspondences and no rival clique is nearly as large."""
    params = params or Params()
    return has_low_nfa(proposal, params) and bool(proposal.runner_up <= MAX_RUNNER_UP)


def has_low_nfa(proposal: Proposal, params: Params) -> bool:
    """Return whether the number of false alarms is below the threshold; False if it was not computed."""
    return bool(proposal.log_nfa < params.max_log_nfa)


def not_significant(proposal: Proposal, params: Params, besides: str = "") -> str:
    """Return the reason why the correspondences alone are not significant, followed by ``besides``."""
    if np.isnan(proposal.log_nfa):
        why = f"proposer {proposal.proposer} does not compute the NFA; log10 NFA must be < {params.max_log_nfa:.1f}"
    elif not has_low_nfa(proposal, params):
        why = f"log10 NFA is {proposal.log_nfa:.1f}, must be < {params.max_log_nfa:.1f}"
    else:
        why = f"a rival clique has {proposal.runner_up:.0%} of the best clique's size, allowed {MAX_RUNNER_UP:.0%}"
    if besides.startswith(_NOT_SIGNIFICANT):
        return besides
    return reason("not_significant", f"{_NOT_SIGNIFICANT}: {why}" + (f" ({besides})" if besides else ""))


def fails_prescreen(evidence: PoseEvidence) -> str:
    """Return the reason why a roughly refined pose is not refined further; empty if it is."""
    if evidence.num_coinciding < _PRESCREEN_MIN_COINCIDING:
        return _too_little(evidence, _PRESCREEN_MIN_COINCIDING)
    pale = evidence.colour_correlation < _PRESCREEN_COLOUR_CORRELATION
    if pale and evidence.colour_t < _PRESCREEN_COLOUR_T:
        return _colours_disagree(evidence, _PRESCREEN_COLOUR_CORRELATION)
    if violates_free_space(evidence.free_space_violation, evidence.num_judged, _PRESCREEN_FREE_SPACE_VIOLATION):
        return _violates(evidence, _PRESCREEN_FREE_SPACE_VIOLATION)
    return ""


def decide(
    proposal: Proposal,
    evidence: PoseEvidence,
    sigmas: tuple[float, float, float] | None,
    params: Params | None = None,
) -> str:
    """Return the reason why a pose is not accepted; empty if it is.

    Args:
        proposal: the proposal, with the refined pose.
        evidence: the evidence under the refined pose.
        sigmas: standard deviations (rad, metres, log scale) of the least certain directions; None without overlap.
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
        return reason(
            "pose_uncertain",
            f"the overlap determines the pose only to {degrees:.1f} deg, {100 * sigmas[1]:.0f} cm, "
            f"{sigmas[2]:.1%} in scale",
        )
    return improbable(proposal, evidence, params)


def contradiction(proposal: Proposal, evidence: PoseEvidence, params: Params) -> str:
    """Return the evidence that alone rules out a pose, whatever supports the pose; empty if there is none."""
    if proposal.flaw:
        return proposal.flaw
    if evidence.num_coinciding < params.min_coinciding:
        return _too_little(evidence, params.min_coinciding)
    if evidence.colour_correlation < params.min_colour_correlation:
        return _colours_disagree(evidence, params.min_colour_correlation)
    if violates_free_space(evidence.free_space_violation, evidence.num_judged, params.max_free_space_violation):
        return _violates(evidence, params.max_free_space_violation)
    return ""


def violates_free_space(share: float, num_judged: float, allowed: float) -> bool:
    """Return whether more free space is violated than is allowed and than a small sample explains.

    Args:
        share: fraction of the Gaussians that violate free space; NaN where no camera observed them.
        num_judged: number of these Gaussians; 0 or NaN where it is unknown.
    """
    from scipy.special import bdtrc  # imported here, as the recipe key does not need it

    if not share > allowed:
        return False
    return not num_judged > 0 or bool(bdtrc(round(share * num_judged) - 1, num_judged, allowed) < _FREE_SPACE_LEVEL)


def is_acceptable(proposal: Proposal, evidence: PoseEvidence, params: Params) -> bool:
    """Return whether nothing contradicts a pose and the pose is probable, even if its uncertainty is large."""
    return not contradiction(proposal, evidence, params) and not improbable(proposal, evidence, params)


def improbable(proposal: Proposal, evidence: PoseEvidence, params: Params) -> str:
    """Return the reason why all evidence together does not make a pose probable enough; empty if it does."""
    probable = probability(proposal, evidence, PRIOR)
    # A significant clique is enough where the cameras of one scene observed too little to verify it.
    if probable >= params.min_probability or (not evidence.num_seen and is_significant(proposal, params)):
        return ""
    weakest = _weakest(proposal, evidence)
    return reason("not_probable", f"not probable enough: {probable:.1%}, needs {params.min_probability:.0%}: {weakest}")


def _weakest(proposal: Proposal, evidence: PoseEvidence) -> str:
    """Describe the two pieces of evidence that lower the probability most."""
    words = {
        "log_nfa": f"chance explains the correspondences (log10 NFA {proposal.log_nfa:.1f})",
        "runner_up": f"a rival clique has {proposal.runner_up:.0%} of the best clique's size",
        "free_space_violation": f"free-space violation {evidence.free_space_violation:.0%}",
        "disagreement": f"{evidence.disagreement:.0%} of the surface seen in both scenes differs",
        "overlap": f"overlap {evidence.overlap:.0%}",
        "num_coinciding": f"only {evidence.num_coinciding} surface cells coincide",
        "colour_correlation": f"colours disagree where surfaces coincide ({evidence.colour_correlation:.2f})",
        "colour_t": f"colours agree by {evidence.colour_t:.1f} standard deviations",
    }
    return ", ".join(words[name] for name in shortfalls(proposal, evidence)[:2])


_NOT_SIGNIFICANT = "not significant"


def _too_little(evidence: PoseEvidence, needs: int) -> str:
    return reason("too_little_overlap", f"too little surface coincides: {evidence.num_coinciding} cells, needs {needs}")


def _colours_disagree(evidence: PoseEvidence, needs: float) -> str:
    correlation = f"{evidence.colour_correlation:.2f}"
    return reason(
        "colours_disagree",
        f"colours disagree where surfaces coincide: correlation {correlation}, needs {needs:.2f}",
    )


def _violates(evidence: PoseEvidence, allowed: float) -> str:
    return reason(
        "free_space_violation", f"free-space violation {evidence.free_space_violation:.0%}, allowed {allowed:.0%}"
    )

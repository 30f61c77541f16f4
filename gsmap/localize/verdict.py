"""Accept a photo's pose, or state the reason for rejecting it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gsmap.localize.probability import PRIOR, load_model
from gsmap.reason_codes import reason
from gsmap.settings.ranges import require_range

MIN_INLIERS = 1
"""Smallest number of tracked patches that must lie where the pose predicts them."""


@dataclass(frozen=True)
class Params:
    """Thresholds for accepting a pose; a wrong pose is worse than no pose.

    Args:
        min_probability: Smallest probability in [0, 1], given all evidence, that an accepted pose is correct; larger
            accepts fewer incorrect and fewer correct poses.
        aliased_prior: Fraction in [0, 0.7) of the candidate poses that are expected to be incorrect because the photo
            shows a room outside the map that looks like a room of the map; larger accepts fewer poses, as hotels and
            schools need (``docs/how-to/localize.md``).
        max_rival_probability: Largest probability, in [0, 1], that the photo shows another place of the map; larger
            accepts more poses, including more poses in a similar but incorrect room.
        max_rotation_sigma_deg: Largest standard deviation of the rotation in degrees, positive; larger accepts less
            accurate poses.
        max_translation_sigma_m: Largest standard deviation of the position in metres, positive; larger accepts less
            accurate poses.
    """

    min_probability: float = 0.95
    aliased_prior: float = 0.1
    max_rival_probability: float = 0.2
    max_rotation_sigma_deg: float = 3.0
    max_translation_sigma_m: float = 0.25

    def __post_init__(self) -> None:
        require_range(self, "[0, 1]", "min_probability", "max_rival_probability")
        require_range(self, "(0, inf]", "max_rotation_sigma_deg", "max_translation_sigma_m")
        require_range(self, f"[0, {1 - PRIOR:g})", "aliased_prior")


def rejection_reason(
    evidence: Mapping[str, float],
    probability: float,
    sigmas: tuple[float, float],
    rival: float,
    params: Params,
    min_inliers: int = MIN_INLIERS,
) -> str:
    """Return the reason why a pose is rejected; empty if it is accepted.

    Args:
        evidence: pieces of evidence by name (`gsmap.localize.probability`).
        sigmas: largest standard deviation of rotation (rad) and translation (metres).
        rival: probability of the best pose at another place.
    """
    inliers = round(10 ** evidence["inliers"] - 1)
    if inliers < min_inliers or not np.isfinite(sigmas).all():
        return reason(
            "not_confirmed",
            f"patches of the map at this pose are not found in the photo: {inliers} found, needs {min_inliers}",
        )
    if probability < params.min_probability:
        return reason(
            "not_probable",
            f"not probable enough: {probability:.1%}, needs {params.min_probability:.0%}: {_weakest(evidence)}",
        )
    if rival > params.max_rival_probability:
        return reason("ambiguous", f"ambiguous: another place of the map looks the same ({rival:.0%} probable)")
    degrees = np.degrees(sigmas[0])
    if degrees > params.max_rotation_sigma_deg or sigmas[1] > params.max_translation_sigma_m:
        return reason(
            "pose_uncertain", f"the photo determines the pose only to {degrees:.1f} deg and {100 * sigmas[1]:.0f} cm"
        )
    return ""


def _weakest(evidence: Mapping[str, float]) -> str:
    """Describe the two pieces of evidence that lack most log-odds."""
    words = {
        "matches": f"{round(10 ** evidence['matches'] - 1)} features agree",
        "inliers": f"{round(10 ** evidence['inliers'] - 1)} patches are found in the photo",
        "found_again": f"{evidence['found_again']:.0%} of the patches are found in the photo",
        "laid": f"an aligned render agrees by {evidence['laid']:.2f}",
        "spread": f"the patches found cover {evidence['spread']:.0%} of the photo",
        "explained": f"the map explains {evidence['explained']:.0%} of the comparable patches",
        "contradicted": f"{evidence['contradicted']:.0%} of the comparable patches differ",
        "explained_coarsely": f"the map explains {evidence['explained_coarsely']:.0%} of the downscaled photo",
        "contradicted_coarsely": f"{evidence['contradicted_coarsely']:.0%} of the downscaled photo differs",
        "unlike_part": f"one region, {evidence['unlike_part']:.0%} of the compared area, shows something else",
        "unlike": f"outside the largest region {evidence['unlike']:.0%} shows something else",
        "unlike_likely": f"further regions, {evidence['unlike_likely']:.0%} of the compared area, likely show "
        "something else",
        "unlike_surely": f"further regions, {evidence['unlike_surely']:.0%} of the compared area, surely show "
        "something else",
        "compared": "little of the photo can be compared",
        "colour": f"colours agree by {evidence['colour']:.2f}",
        "seen": f"the map covers {evidence['seen']:.0%} of the photo",
        "blocked": f"a surface would block {evidence['blocked']:.0%} of the photo",
        "sigma_m": f"its position is certain to {10 ** evidence['sigma_m']:.2g} m",
    }
    return ", ".join(words[name] for name in load_model().shortfalls(evidence)[:2])

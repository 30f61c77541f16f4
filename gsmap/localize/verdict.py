"""Whether a photograph's pose is said, or the reason why not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gsmap.errors import ConfigError
from gsmap.localize.probability import model
from gsmap.reason_codes import reason


@dataclass(frozen=True)
class Params:
    """What a pose must show. A wrong place is worse than none.

    Args:
        min_probability: that it is right, of all evidence together.
        prior: share of the poses that are looked into that are right before anything is known of them ...
        alike: ... and of those that are of a room that looks like one of the map, and is not in it: more in a hotel or
            a school, less where no two rooms are alike (``docs/how-to/localize.md`` says what either costs).
        min_inliers: patches of renders that are found again in the photo where the pose predicts them.
        max_rival: another place may be this probable at most: what looks alike twice is not told apart.
        max_rotation_sigma_deg: a pose that is known less well is not said ...
        max_translation_sigma_m: ... nor one whose place is.
    """

    min_probability: float = 0.95
    prior: float = 0.3
    alike: float = 0.1
    min_inliers: int = 1
    max_rival: float = 0.2
    max_rotation_sigma_deg: float = 3.0
    max_translation_sigma_m: float = 0.25

    def __post_init__(self) -> None:
        if not (self.prior > 0 and self.alike >= 0 and self.prior + self.alike < 1):
            raise ConfigError(
                "prior and alike are shares of the poses that are looked into: prior above 0, alike 0 or more, "
                f"together less than 1; got prior={self.prior}, alike={self.alike}",
                code="out_of_range",
            )


def judge(
    evidence: Mapping[str, float], probability: float, sigmas: tuple[float, float], rival: float, params: Params
) -> str:
    """Empty when the pose is said, else the reason why not.

    Args:
        evidence: by name (`gsmap.localize.localizing.judged_pose`).
        sigmas: largest standard deviation of rotation (rad) and translation (metres).
        rival: probability of the best pose at another place.
    """
    inliers = round(10 ** evidence["inliers"] - 1)
    if inliers < params.min_inliers or not np.isfinite(sigmas).all():
        return reason(
            "not_confirmed",
            f"what the map shows there is not in the picture: {inliers} patches found, needs {params.min_inliers}",
        )
    if probability < params.min_probability:
        return reason(
            "not_probable",
            f"not probable enough: {probability:.1%}, needs {params.min_probability:.0%}: {_weakest(evidence)}",
        )
    if rival > params.max_rival:
        return reason("ambiguous", f"ambiguous: another place of the map shows the same ({rival:.0%} probable)")
    degrees = np.degrees(sigmas[0])
    if degrees > params.max_rotation_sigma_deg or sigmas[1] > params.max_translation_sigma_m:
        return reason(
            "pose_uncertain", f"what it shows fixes its pose only to {degrees:.1f} deg and {100 * sigmas[1]:.0f} cm"
        )
    return ""


def _weakest(evidence: Mapping[str, float]) -> str:
    """The two pieces of evidence that a sure pose would show otherwise, in words."""
    words = {
        "matches": f"{round(10 ** evidence['matches'] - 1)} features agree",
        "inliers": f"{round(10 ** evidence['inliers'] - 1)} patches are found again",
        "found_again": f"{evidence['found_again']:.0%} of the patches are found again",
        "laid": f"a render that is laid over it agrees by {evidence['laid']:.2f}",
        "spread": f"what is found again covers {evidence['spread']:.0%} of the picture",
        "explained": f"the map explains {evidence['explained']:.0%} of what can be compared",
        "contradicted": f"{evidence['contradicted']:.0%} of what can be compared differs",
        "explained_coarsely": f"the map explains {evidence['explained_coarsely']:.0%} of the coarse picture",
        "contradicted_coarsely": f"{evidence['contradicted_coarsely']:.0%} of the coarse picture differs",
        "unlike_part": f"one part, {evidence['unlike_part']:.0%} of what is compared, is something else",
        "unlike": f"{evidence['unlike']:.0%} of the rest is something else",
        "unlike_likely": f"other parts, {evidence['unlike_likely']:.0%} of what is compared, are likely something else",
        "unlike_surely": f"other parts, {evidence['unlike_surely']:.0%} of what is compared, are surely something else",
        "compared": "little can be compared",
        "colour": f"colours agree by {evidence['colour']:.2f}",
        "seen": f"the map covers {evidence['seen']:.0%} of the picture",
        "blocked": f"{evidence['blocked']:.0%} of the picture would be blocked",
        "sigma_m": f"its place is known to {10 ** evidence['sigma_m']:.2g} m",
    }
    return ", ".join(words[name] for name in model().shortfalls(evidence)[:2])

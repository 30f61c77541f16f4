"""Compute the probability that a photo's pose is correct from all evidence together.

A pose is correct, or lies at an unrelated place, or in an aliased room (a room that looks like that of the photo). The
evidence has different weights against both wrong alternatives, and each alternative has its own prior
(`gsmap.localize.verdict.Params`). The curves of `gsmap.compare.odds` are fitted by ``tools/fit/localize.py`` on
synthetic places with changed light, lenses and content, and on streets with aliased rooms.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files

import numpy as np

from gsmap.compare.odds import Odds
from gsmap.localize import evidence
from gsmap.localize.mismatch import MISMATCH_PROBABILITY, MismatchMap
from gsmap.localize.refinement import RefinedPose, ScaledPhoto

PRIOR = 0.3
"""Share of the candidate poses that are correct."""

_FILE = "probability.json"
_BLOCKS = (8, 6)  # columns and rows of the photo over which inliers should be spread
_HIGH_MISMATCH_PROBABILITY = 0.8


@dataclass(frozen=True)
class EvidenceModel:
    """Log-odds of evidence for a pose against two alternatives.

    Args:
        other: log-odds against an unrelated place.
        aliased: log-odds against an aliased room.
    """

    other: Odds
    aliased: Odds

    def probability(
        self, evidence: Mapping[str, float], aliased_prior: float, prior: float = PRIOR, *, optimistic: bool = False
    ) -> float:
        """Return the probability that a pose is correct.

        Args:
            evidence: pieces of evidence by name.
        aliased_prior: share of the candidate poses that lie in an aliased room.
        prior: share of the candidate poses that are correct.
        optimistic: assume that missing evidence is as good as possible.
        """
        against = (1 - prior - aliased_prior) * np.exp(-self.other.log_odds(evidence, at_best=optimistic))
        against += aliased_prior * np.exp(-self.aliased.log_odds(evidence, at_best=optimistic))
        return float(np.clip(prior / (prior + against), self.other.least, 1 - self.other.least))

    def shortfalls(self, evidence: Mapping[str, float]) -> list[str]:
        """Return the names of the evidence against the likelier alternative, sorted by how far the log-odds of each are
        below their best value, the farthest first."""
        return min((self.other, self.aliased), key=lambda odds: odds.log_odds(evidence)).shortfalls(evidence)


@lru_cache(maxsize=1)
def load_model() -> EvidenceModel:
    """Load the model of this package."""
    stored = json.loads((files("gsmap.localize") / _FILE).read_text())
    return EvidenceModel(Odds.of_stored(stored["other"]), Odds.of_stored(stored["alike"]))


def refinement_evidence(
    photo: ScaledPhoto, refined: RefinedPose, sigmas: tuple[float, float], num_matches: int
) -> dict[str, float]:
    """Return the evidence from refining a pose, scaled so that equal steps have about equal weight.

    Args:
        sigmas: largest standard deviation of rotation (rad) and translation (metres).
        num_matches: features of the photo that agree with the candidate pose.
    """
    inliers = refined.inliers(photo.size_px)
    count = int(inliers.sum())
    return {
        "matches": float(np.log10(num_matches + 1)),
        "inliers": float(np.log10(count + 1)),
        "found_again": count / refined.num_tracked if refined.num_tracked else 0.0,
        "laid": refined.agreement,
        "spread": block_coverage(refined.pixels[inliers], photo.size_px),
        "sigma_m": float(np.log10(np.clip(sigmas[1] / refined.scale, 1e-4, 10.0))),
    }


def render_evidence(
    comparison: evidence.RenderComparison, coarse: evidence.RenderComparison, mismatch: MismatchMap
) -> dict[str, float]:
    """Return the evidence from comparing the photo with renders, scaled likewise; NaN where a piece is missing.

    Args:
        comparison, coarse: comparisons at full and at reduced size, without the largest part of the mismatch.
    """
    return {
        "explained": comparison.explained(),
        "contradicted": comparison.contradicted(),
        "explained_coarsely": coarse.explained(),
        "contradicted_coarsely": coarse.contradicted(),
        "unlike_part": mismatch.part_share(),
        "unlike": mismatch.mean_outside(),
        "unlike_likely": mismatch.share_outside(MISMATCH_PROBABILITY),
        "unlike_surely": mismatch.share_outside(_HIGH_MISMATCH_PROBABILITY),
        "compared": float(np.log10(comparison.num_compared + 1)),
        "colour": comparison.colour,
        "seen": comparison.seen,
        "blocked": comparison.blocked,
    }


def block_coverage(pixels: np.ndarray, size_px: tuple[int, int]) -> float:
    """Return the share of the photo's blocks that contain any of the pixels (K, 2)."""
    at = np.clip((pixels / size_px * _BLOCKS).astype(int), 0, np.array(_BLOCKS) - 1)
    return len(np.unique(at[:, 1] * _BLOCKS[0] + at[:, 0])) / (_BLOCKS[0] * _BLOCKS[1])

"""How probable it is that a photograph was taken where it is said to have been, of all evidence together.

What looks like the place is the place, another one that shares nothing with it, or a room that looks alike: against
either of the last two the evidence is worth something else, and how frequent they are is told apart
(`gsmap.localize.verdict.Params`). The curves of `gsmap.compare.odds` are fitted by ``tools/fit/localize.py`` on made
places, photographed in other light by other lenses, some of them changed or with somebody in the picture, and on
streets whose rooms look alike.
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
from gsmap.localize.settling import Picture, Settled, inliers
from gsmap.localize.unlike import Unlike

_FILE = "probability.json"


@dataclass(frozen=True)
class Model:
    """What evidence is worth for a pose against what else it may be.

    Args:
        other: against a place that has nothing to do with the photograph.
        alike: against a room that looks like the photograph's.
    """

    other: Odds
    alike: Odds

    def probability(self, told: Mapping[str, float], right: float, alike: float, *, at_best: bool = False) -> float:
        """That a pose is right.

        Args:
            told: evidence by name.
            right: share of the poses that are looked into that are right ...
            alike: ... and of those that are of a room that looks alike, before anything is known of them.
            at_best: what is not named is as good as can be.
        """
        against = (1 - right - alike) * np.exp(-self.other.log_odds(told, at_best=at_best))
        against += alike * np.exp(-self.alike.log_odds(told, at_best=at_best))
        return float(np.clip(right / (right + against), self.other.least, 1 - self.other.least))

    def shortfalls(self, told: Mapping[str, float]) -> list[str]:
        """The names of the evidence, what lacks most of what it could be worth against what is likelier first."""
        return min((self.other, self.alike), key=lambda odds: odds.log_odds(told)).shortfalls(told)


@lru_cache(maxsize=1)
def model() -> Model:
    """The model that gsmap comes with."""
    stored = json.loads((files("gsmap.localize") / _FILE).read_text())
    return Model(Odds.of_stored(stored["other"]), Odds.of_stored(stored["alike"]))


def evidence_of_settling(
    picture: Picture, settled: Settled, sigmas: tuple[float, float], num_matches: int, params: evidence.Params
) -> dict[str, float]:
    """What settling a pose tells; each piece such that a step of it means about the same everywhere.

    Args:
        sigmas: largest standard deviation of rotation (rad) and translation (metres).
        num_matches: features of the photo that agreed on the rough pose.
    """
    kept = inliers(settled, params, picture.size_px)
    count = int(kept.sum())
    return {
        "matches": float(np.log10(num_matches + 1)),
        "inliers": float(np.log10(count + 1)),
        "found_again": count / settled.tried if settled.tried else 0.0,
        "laid": settled.agreement,
        "spread": evidence.spread(settled.pixels[kept], picture.size_px, params.blocks),
        "sigma_m": float(np.log10(np.clip(sigmas[1], 1e-4, 10.0))),
    }


def evidence_of_looks(
    comparison: evidence.Comparison, coarse: evidence.Comparison, other: Unlike, params: evidence.Params
) -> dict[str, float]:
    """What the map shows from there, likewise; NaN where something could not be had.

    Args:
        comparison, coarse: of the photo with renders from there, as they are and in smaller pictures, but for the part
            of it that shows something else.
        other: how much of it does.
    """
    return {
        "explained": comparison.explained(params.agree),
        "contradicted": comparison.contradicted(params.contradict),
        "explained_coarsely": coarse.explained(params.agree),
        "contradicted_coarsely": coarse.contradicted(params.contradict),
        "unlike_part": other.in_part(),
        "unlike": other.outside(),
        "unlike_likely": other.surely_outside(params.likely),
        "unlike_surely": other.surely_outside(params.surely),
        "compared": float(np.log10(comparison.num_judged + 1)),
        "colour": comparison.colour,
        "seen": comparison.seen,
        "blocked": comparison.blocked,
    }

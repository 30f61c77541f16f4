"""How probable it is that a photograph was taken where it is said to have been, of all evidence together.

The curves of `gsmap.compare.odds` are fitted by ``tools/fit_localize.py`` on made places, photographed in other light
by other lenses, some of them changed or with somebody in the picture, and on places that look alike.
"""

from __future__ import annotations

from functools import lru_cache
from importlib.resources import files

import numpy as np

from gsmap.compare.odds import Odds
from gsmap.localize import evidence
from gsmap.localize.settling import Picture, Settled, inliers
from gsmap.localize.unlike import Unlike

_FILE = "probability.json"


@lru_cache(maxsize=1)
def model() -> Odds:
    """The model that gsmap comes with."""
    return Odds.of_json((files("gsmap.localize") / _FILE).read_text())


def evidence_of(
    picture: Picture,
    settled: Settled,
    comparison: evidence.Comparison,
    coarse: evidence.Comparison,
    sigmas: tuple[float, float],
    num_matches: int,
    params: evidence.Params,
) -> dict[str, float]:
    """The pieces of evidence that have a curve, each such that a step of it means about the same everywhere, but for
    those of `evidence_of_unlike`.

    NaN where one could not be had.

    Args:
        comparison, coarse: of the photo with renders from there, as they are and in smaller pictures.
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
        "explained": comparison.explained(params.agree),
        "contradicted": comparison.contradicted(params.contradict),
        "explained_coarsely": coarse.explained(params.agree),
        "contradicted_coarsely": coarse.contradicted(params.contradict),
        "compared": float(np.log10(comparison.num_judged + 1)),
        "colour": comparison.colour,
        "seen": comparison.seen,
        "blocked": comparison.blocked,
        "sigma_m": float(np.log10(np.clip(sigmas[1], 1e-4, 10.0))),
    }


def evidence_of_unlike(other: Unlike, params: evidence.Params) -> dict[str, float]:
    """What speaks against a room that looks like it: how much of the photo shows something else, and how much of that
    lies in several places."""
    return {
        "unlike": other.share(),
        "unlike_likely": other.elsewhere(params.likely),
        "unlike_surely": other.elsewhere(params.surely),
    }

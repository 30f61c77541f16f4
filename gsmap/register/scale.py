"""Which scales could lay one set of nodes on the other: votes of distance ratios."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.register.correspondences import Correspondences


@dataclass(frozen=True)
class Params:
    """How scales are voted for.

    Args:
        max_factor: largest scale between the two layers once both are in (guessed) metres; graphs hold a layer for
            every 1.45, so that some two are always nearer than this.
        bin_width: of the histogram over the logarithm of the ratio.
        min_distance_m: closer pairs tell too little of the scale.
        max_correspondences: most similar candidates that vote.
        rise_tolerance: difference of the two slopes of a pair of nodes, where gravity is known.
        num_peaks: scales that one pair of layers proposes.
    """

    max_factor: float = 1.35
    bin_width: float = 0.01
    min_distance_m: float = 1.0
    max_correspondences: int = 1000
    rise_tolerance: float = 0.06
    num_peaks: int = 3


def vote_scales(matches: Correspondences, params: Params | None = None) -> list[tuple[float, float]]:
    """Scales (source to target) most voted for by pairs of candidates, and how far each stands out; best first.

    Two right correspondences a distance d apart give the ratio ``|dq| / |dp|`` within ``sigma / d``; wrong ones spread
    over everything. The smooth background is taken off before peaks are ranked by their significance.
    """
    from scipy.ndimage import gaussian_filter1d

    from gsmap import _native

    params = params or Params()
    matches = matches[np.arange(min(len(matches), params.max_correspondences))]
    limit, margin = np.log(params.max_factor), 0.3
    bins = int(np.ceil(2 * (limit + margin) / params.bin_width))
    # Where gravity is known a right pair of pairs also rises alike, whatever the scale.
    counts = _native.ratio_histogram(
        target=matches.target,
        source=matches.source,
        target_ids=matches.target_ids,
        source_ids=matches.source_ids,
        target_heights=matches.target_heights,
        source_heights=matches.source_heights,
        min_distance=params.min_distance_m,
        rise_tolerance=params.rise_tolerance,
        limit=limit + margin,
        bins=bins,
    )
    edges = np.linspace(-limit - margin, limit + margin, bins + 1)
    smooth = gaussian_filter1d(counts.astype(float), 1.5)
    background = gaussian_filter1d(counts.astype(float), 0.1 / params.bin_width)
    centres = 0.5 * (edges[1:] + edges[:-1])
    score = (smooth - background) / np.sqrt(background + 1.0)
    score[np.abs(centres) > limit] = -np.inf
    scales: list[tuple[float, float]] = []
    for at in np.argsort(-score, kind="stable"):
        if len(scales) == params.num_peaks or score[at] <= 0:
            break
        if all(abs(centres[at] - np.log(s)) > 3.5 * params.bin_width for s, _ in scales):
            scales.append((float(np.exp(centres[at])), float(score[at])))
    return scales

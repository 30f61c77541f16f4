"""Estimate the scale between two sets of nodes by a vote of distance ratios."""

from __future__ import annotations

import numpy as np

from gsmap.register.correspondences import Correspondences

# Largest scale between two layers once both are in (estimated) metres. Graphs have a layer for every factor of 1.45, so
# some pair of layers always differs by less.
_MAX_FACTOR = 1.35
_BIN_WIDTH = 0.01  # of the histogram over the logarithm of the ratio
_MIN_DISTANCE_M = 1.0  # closer pairs hardly constrain the scale
_MAX_CORRESPONDENCES = 1000  # the most similar ones
_RISE_TOLERANCE = 0.06  # difference of the two slopes of a pair of nodes, where gravity is known
_NUM_PEAKS = 3


def vote_scales(matches: Correspondences) -> list[tuple[float, float]]:
    """Return the scales (source to target) with most votes, each with its significance, best first; every pair of
    candidates votes.

    Two correct correspondences at a distance d give the true ratio ``|dq| / |dp|`` with a relative error of about
    ``sigma / d``; wrong ones give ratios spread over all values. The smooth background is subtracted before peaks are
    ranked by their significance.
    """
    from scipy.ndimage import gaussian_filter1d

    from gsmap import _native

    matches = matches[np.arange(min(len(matches), _MAX_CORRESPONDENCES))]
    limit, margin = np.log(_MAX_FACTOR), 0.3
    bins = int(np.ceil(2 * (limit + margin) / _BIN_WIDTH))
    # Where gravity is known, both distances of a correct pair also have the same slope, whatever the scale.
    counts = _native.ratio_histogram(
        target=matches.target,
        source=matches.source,
        target_ids=matches.target_ids,
        source_ids=matches.source_ids,
        target_heights=matches.target_heights,
        source_heights=matches.source_heights,
        min_distance=_MIN_DISTANCE_M,
        rise_tolerance=_RISE_TOLERANCE,
        limit=limit + margin,
        bins=bins,
    )
    edges = np.linspace(-limit - margin, limit + margin, bins + 1)
    smooth = gaussian_filter1d(counts.astype(float), 1.5)
    background = gaussian_filter1d(counts.astype(float), 0.1 / _BIN_WIDTH)
    centres = 0.5 * (edges[1:] + edges[:-1])
    score = (smooth - background) / np.sqrt(background + 1.0)
    score[np.abs(centres) > limit] = -np.inf
    scales: list[tuple[float, float]] = []
    for at in np.argsort(-score, kind="stable"):
        if len(scales) == _NUM_PEAKS or score[at] <= 0:
            break
        if all(abs(centres[at] - np.log(s)) > 3.5 * _BIN_WIDTH for s, _ in scales):
            scales.append((float(np.exp(centres[at])), float(score[at])))
    return scales

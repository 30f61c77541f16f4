"""Which scales could lay one set of nodes on the other: votes of distance ratios."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.register.correspondences import Correspondences


@dataclass(frozen=True)
class Params:
    """Args:
    max_factor: largest scale between the two layers once both are in (guessed) metres; graphs hold a layer for
        every 1.45, so that some two are always nearer than this.
    bin_width: of the histogram over the logarithm of the ratio.
    min_distance_m: closer pairs say too little of the scale.
    max_correspondences: most similar candidates that vote.
    num_peaks: scales that are tried.
    """

    max_factor: float = 1.35
    bin_width: float = 0.01
    min_distance_m: float = 1.0
    max_correspondences: int = 700
    num_peaks: int = 3


def vote_scales(matches: Correspondences, params: Params | None = None) -> list[tuple[float, float]]:
    """Scales (source to target) most voted for by pairs of candidates, and how far each stands out; best first.

    Two right correspondences a distance d apart give the ratio ``|dq| / |dp|`` within ``sigma / d``; wrong ones spread
    over everything. The smooth background is taken off before peaks are ranked by their significance.
    """
    from scipy.ndimage import gaussian_filter1d

    params = params or Params()
    matches = matches[np.arange(min(len(matches), params.max_correspondences))]
    i, j = np.triu_indices(len(matches), 1)
    apart = (matches.target_ids[i] != matches.target_ids[j]) & (matches.source_ids[i] != matches.source_ids[j])
    i, j = i[apart], j[apart]
    target, source = matches.target.astype(np.float32), matches.source.astype(np.float32)
    dt = np.linalg.norm(target[i] - target[j], axis=1)
    ds = np.linalg.norm(source[i] - source[j], axis=1)
    far = (dt > params.min_distance_m) & (ds > params.min_distance_m)
    ratio = np.log(dt[far]) - np.log(ds[far])
    if matches.target_heights is not None:
        rise_t = (matches.target_heights[i] - matches.target_heights[j])[far]
        rise_s = (matches.source_heights[i] - matches.source_heights[j])[far]
        level = np.abs(rise_t / dt[far] - rise_s / ds[far]) < 0.1
        ratio = ratio[level]
    limit = np.log(params.max_factor)
    bins = int(np.ceil(2 * limit / params.bin_width))
    counts, edges = np.histogram(ratio, bins, (-limit, limit))
    smooth = gaussian_filter1d(counts.astype(float), 1.5)
    background = gaussian_filter1d(counts.astype(float), 0.15 / params.bin_width)
    score = (smooth - background) / np.sqrt(background + 1.0)
    centres = 0.5 * (edges[1:] + edges[:-1])
    scales: list[tuple[float, float]] = []
    for at in np.argsort(-score, kind="stable"):
        if len(scales) == params.num_peaks or score[at] <= 0:
            break
        if all(abs(centres[at] - np.log(s)) > 3.5 * params.bin_width for s, _ in scales):
            scales.append((float(np.exp(centres[at])), float(score[at])))
    return scales

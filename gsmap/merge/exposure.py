"""Captures taken with different exposure and white balance, brought to one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmap.merge.parts import Part, overlapping, share_in_view
from gsmap.render import render
from gsmap.types import Cameras, Gaussians

_VIEWS_PER_PAIR = 6
_LONGEST_SIDE_PX = 160
_MIN_PIXELS = 500
_SAME_SURFACE = 0.05  # relative depth difference of one surface
_NEGLIGIBLE = 0.01  # a log-gain below this is noise of the estimate
_LARGEST = np.log(4.0)
_SH_0 = 0.28209479177387814


def balance_exposure(parts: list[Part]) -> tuple[list[Part], np.ndarray]:
    """The parts with one gain per part and colour channel removed, and the log-gains (P, 3) that were added.

    Gains are the least-squares answer to the median log-ratios of colour wherever two captures show the same surface;
    their mean over parts that are tied together is zero, so the brightness of the whole stays.
    """
    log_gains = _solve(len(parts), _ratios(parts))
    if np.abs(log_gains).max(initial=0) < _NEGLIGIBLE:
        return parts, np.zeros_like(log_gains)
    balanced = [
        replace(part, gaussians=apply_gain(part.gaussians, np.exp(gain)))
        for part, gain in zip(parts, log_gains, strict=True)
    ]
    return balanced, log_gains


def apply_gain(gaussians: Gaussians, gain: np.ndarray) -> Gaussians:
    """Gaussians whose colours are multiplied by ``gain`` (3,), exactly, from every direction."""
    sh = gaussians.sh * gain.astype(np.float32)
    # Colour is SH + 0.5: the offset must grow too.
    sh[:, 0] += ((gain - 1) * 0.5 / _SH_0).astype(np.float32)
    return replace(gaussians, sh=sh)


def _ratios(parts: list[Part]) -> list[tuple[int, int, np.ndarray, float]]:
    """(i, j, median log(colour_i / colour_j) (3,), pixels) of every pair of parts that show a surface in common."""
    found = []
    for i, part in enumerate(parts):
        for j, other in enumerate(parts):
            if i == j or part.cameras is None or not overlapping(part, other):
                continue
            cameras = _looking_at(part.cameras, other.gaussians)
            samples = [_same_surface(part, other, cameras[c]) for c in range(len(cameras))]
            ratios = np.concatenate(samples) if samples else np.zeros((0, 3))
            if len(ratios) >= _MIN_PIXELS:
                found.append((i, j, np.median(ratios, axis=0), float(len(ratios))))
    return found


def _looking_at(cameras: Cameras, gaussians: Gaussians) -> Cameras:
    """The few cameras that have most of the Gaussians' means in view."""
    share = share_in_view(cameras, gaussians.means)
    best = np.argsort(-share, kind="stable")[:_VIEWS_PER_PAIR]
    return cameras[best[share[best] > 0]].resized(_LONGEST_SIDE_PX)


def _same_surface(part: Part, other: Part, camera: Cameras) -> np.ndarray:
    """(K, 3) log-ratios of colour at pixels where both parts show one surface, neither black nor blown out."""
    a, b = render(part.gaussians, camera), render(other.gaussians, camera)
    depth = np.minimum(a.depth[0], b.depth[0])
    same = (a.alpha[0] > 0.95) & (b.alpha[0] > 0.95) & (np.abs(a.depth[0] - b.depth[0]) < _SAME_SURFACE * depth)
    colour_a, colour_b = a.colour[0][same], b.colour[0][same]
    usable = ((colour_a > 0.05) & (colour_a < 0.95) & (colour_b > 0.05) & (colour_b < 0.95)).all(1)
    return np.log(colour_a[usable] / colour_b[usable])


def _solve(count: int, ratios: list[tuple[int, int, np.ndarray, float]]) -> np.ndarray:
    """Log-gains (count, 3) to add, so that ``gain_i - gain_j = -ratio_ij`` in the weighted least-squares sense."""
    normal, right = np.zeros((count, count)), np.zeros((count, 3))
    for i, j, ratio, weight in ratios:
        normal[[i, j], [i, j]] += weight
        normal[[i, j], [j, i]] -= weight
        right[i] -= weight * ratio
        right[j] += weight * ratio
    # The pseudo-inverse gives every group of tied parts a mean of zero.
    return np.clip(np.linalg.pinv(normal, hermitian=True) @ right, -_LARGEST, _LARGEST)

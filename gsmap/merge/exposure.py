"""Balance exposure: bring scenes to a common exposure and white balance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gsmap.compare import Balance
from gsmap.compare.colours import FLOOR
from gsmap.geometry.sh import SH_C0, rgb_of_sh0, sh0_of_rgb
from gsmap.merge.overlap import boxes_overlap, share_in_view
from gsmap.render import render
from gsmap.types import Cameras, Gaussians, PosedScene, ReferencePhoto

# For each pair: number of views of one scene that see most of the other, and their size.
_MAX_VIEWS, _LONGEST_SIDE_PX = 6, 160
_MIN_PIXELS = 500  # smallest number of pixels that show one surface in both scenes for a gain to be estimated
_MAX_DEPTH_RATIO = 0.05  # largest relative difference in depth between pixels of one surface
_MIN_ALPHA = 0.95  # smallest alpha of a pixel that shows a surface
_MIN_COLOUR, _MAX_COLOUR = 0.05, 0.95  # colours outside this range are black or saturated
_NEGLIGIBLE_LOG_GAIN = 0.01
_MAX_GAIN = 4.0


def balance_exposure(scenes: Sequence[PosedScene]) -> tuple[list[PosedScene], np.ndarray]:
    """Balance scenes by one gain per scene and colour channel; return the scenes and the applied log-gains (S, 3).

    The log-gains are the least-squares fit to the median log-ratios of colour on surfaces that pairs of scenes share.
    Their mean over connected scenes is zero, which preserves the overall brightness.
    """
    log_gains = _solve(len(scenes), _ratios(scenes))
    if np.abs(log_gains).max(initial=0) < _NEGLIGIBLE_LOG_GAIN:
        return list(scenes), np.zeros_like(log_gains)
    balanced = [
        replace(
            scene,
            gaussians=apply_gain(scene.gaussians, np.exp(gain)),
            photos=tuple(_with_gain(photo, np.exp(gain)) for photo in scene.photos),
        )
        for scene, gain in zip(scenes, log_gains, strict=True)
    ]
    return balanced, log_gains


def _with_gain(photo: ReferencePhoto, gain: np.ndarray) -> ReferencePhoto:
    """Apply a gain to the scene colours to which a photo's colours are balanced."""
    around = photo.around
    return photo if around is None else replace(photo, around=lambda: apply_gain(around(), gain))


def apply_gain(gaussians: Gaussians, gain: np.ndarray) -> Gaussians:
    """Multiply the colours of Gaussians by ``gain`` (3,), exactly and for every viewing direction."""
    sh = gaussians.sh * gain.astype(np.float32)
    # Colour is SH + 0.5, so the offset must be scaled as well.
    sh[:, 0] += ((gain - 1) * 0.5 / SH_C0).astype(np.float32)
    return replace(gaussians, sh=sh)


def apply_balance(gaussians: Gaussians, balance: Balance) -> Gaussians:
    """Convert Gaussians to the exposure of another capture by a balance of gain, gamma and white balance.

    Mean colours follow the balance, and direction-dependent terms are multiplied by its local slope.
    """
    colours = rgb_of_sh0(gaussians.sh[:, 0]).astype(np.float64)
    within = np.clip(colours, 0, 1)
    slope = balance.slope * (within + FLOOR) ** (balance.slope - 1) * np.exp(balance.offset)
    moved = (within + FLOOR) ** balance.slope * np.exp(balance.offset) - FLOOR + slope * (colours - within)
    sh = gaussians.sh * slope[:, None].astype(np.float32)
    sh[:, 0] = sh0_of_rgb(moved.astype(np.float32)[:, None])[:, 0]
    return replace(gaussians, sh=sh)


def _ratios(scenes: Sequence[PosedScene]) -> list[tuple[int, int, np.ndarray, float]]:
    """For every pair of scenes with a common surface return (i, j, median log(colour_i / colour_j) (3,), number of
    pixels)."""
    found = []
    for i, scene in enumerate(scenes):
        for j, other in enumerate(scenes):
            if i == j or scene.cameras is None or not boxes_overlap(scene, other):
                continue
            cameras = _looking_at(scene.cameras, other.gaussians)
            samples = [_same_surface(scene, other, cameras[c]) for c in range(len(cameras))]
            ratios = np.concatenate(samples) if samples else np.zeros((0, 3))
            if len(ratios) >= _MIN_PIXELS:
                found.append((i, j, np.median(ratios, axis=0), float(len(ratios))))
    return found


def _looking_at(cameras: Cameras, gaussians: Gaussians) -> Cameras:
    """Select the few cameras that have most of the Gaussians in view."""
    share = share_in_view(cameras, gaussians.means)
    best = np.argsort(-share, kind="stable")[:_MAX_VIEWS]
    return cameras[best[share[best] > 0]].resized(_LONGEST_SIDE_PX)


def _same_surface(scene: PosedScene, other: PosedScene, camera: Cameras) -> np.ndarray:
    """Return the (K, 3) log-ratios of colour at pixels of a common surface that are neither black nor saturated."""
    a, b = render(scene.gaussians, camera), render(other.gaussians, camera)
    same = np.abs(a.depth[0] - b.depth[0]) < _MAX_DEPTH_RATIO * np.minimum(a.depth[0], b.depth[0])
    same &= (a.alpha[0] > _MIN_ALPHA) & (b.alpha[0] > _MIN_ALPHA)
    colours = np.stack([a.colour[0][same], b.colour[0][same]])
    usable = ((colours > _MIN_COLOUR) & (colours < _MAX_COLOUR)).all((0, 2))
    ratios: np.ndarray = np.log(colours[0][usable] / colours[1][usable])
    return ratios


def _solve(count: int, ratios: list[tuple[int, int, np.ndarray, float]]) -> np.ndarray:
    """Solve for log-gains (count, 3) with ``gain_i - gain_j = -ratio_ij`` by weighted least squares."""
    normal, right = np.zeros((count, count)), np.zeros((count, 3))
    for i, j, ratio, weight in ratios:
        normal[[i, j], [i, j]] += weight
        normal[[i, j], [j, i]] -= weight
        right[i] -= weight * ratio
        right[j] += weight * ratio
    largest = np.log(_MAX_GAIN)
    # The pseudo-inverse gives every group of connected scenes a mean log-gain of zero.
    return np.clip(np.linalg.pinv(normal, hermitian=True) @ right, -largest, largest)

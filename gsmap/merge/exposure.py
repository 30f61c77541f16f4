"""Captures taken with different exposure and white balance, brought to one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gsmap.compare import Balance
from gsmap.compare.colours import FLOOR
from gsmap.geometry.sh import SH_C0, rgb_of_sh0, sh0_of_rgb
from gsmap.merge.placed import overlapping, share_in_view
from gsmap.render import render
from gsmap.types import Cameras, Gaussians, KeptPhoto, PlacedScene

_MAX_VIEWS, _LONGEST_SIDE_PX = 6, 160  # of a pair: views of one scene that see most of the other, and their size
_MIN_PIXELS = 500  # that show one surface in both scenes, for a gain to be estimated
_MAX_DEPTH_RATIO = 0.05  # relative difference in depth of one surface
_MIN_ALPHA = 0.95  # of a pixel that shows a surface
_MIN_COLOUR, _MAX_COLOUR = 0.05, 0.95  # colours outside are black or saturated
_NEGLIGIBLE_LOG_GAIN = 0.01
_MAX_GAIN = 4.0


def balance_exposure(scenes: Sequence[PlacedScene]) -> tuple[list[PlacedScene], np.ndarray]:
    """The scenes with one gain per scene and colour channel removed, and the log-gains (S, 3) that were added.

    Gains are the least-squares answer to the median log-ratios of colour wherever two captures show the same surface;
    their mean over scenes that are tied together is zero, so the brightness of the whole stays.
    """
    log_gains = _solve(len(scenes), _ratios(scenes), np.log(_MAX_GAIN))
    if np.abs(log_gains).max(initial=0) < _NEGLIGIBLE_LOG_GAIN:
        return list(scenes), np.zeros_like(log_gains)
    balanced = [
        replace(
            scene,
            gaussians=apply_gain(scene.gaussians, np.exp(gain)),
            photos=tuple(_beside(photo, np.exp(gain)) for photo in scene.photos),
        )
        for scene, gain in zip(scenes, log_gains, strict=True)
    ]
    return balanced, log_gains


def _beside(photo: KeptPhoto, gain: np.ndarray) -> KeptPhoto:
    """A photograph that is brought to the colours of what is around it, in other colours."""
    around = photo.around
    return photo if around is None else replace(photo, around=lambda: apply_gain(around(), gain))


def apply_gain(gaussians: Gaussians, gain: np.ndarray) -> Gaussians:
    """Gaussians whose colours are multiplied by ``gain`` (3,), exactly, from every direction."""
    sh = gaussians.sh * gain.astype(np.float32)
    # Colour is SH + 0.5: the offset must grow too.
    sh[:, 0] += ((gain - 1) * 0.5 / SH_C0).astype(np.float32)
    return replace(gaussians, sh=sh)


def apply_balance(gaussians: Gaussians, balance: Balance) -> Gaussians:
    """Gaussians in the exposure of another capture: their mean colours on the line of a balance, so that gain, gamma
    and white balance are in it; what depends on the direction is multiplied by the slope of the line there."""
    colours = rgb_of_sh0(gaussians.sh[:, 0]).astype(np.float64)
    within = np.clip(colours, 0, 1)
    slope = balance.slope * (within + FLOOR) ** (balance.slope - 1) * np.exp(balance.offset)
    moved = (within + FLOOR) ** balance.slope * np.exp(balance.offset) - FLOOR + slope * (colours - within)
    sh = gaussians.sh * slope[:, None].astype(np.float32)
    sh[:, 0] = sh0_of_rgb(moved.astype(np.float32)[:, None])[:, 0]
    return replace(gaussians, sh=sh)


def _ratios(scenes: Sequence[PlacedScene]) -> list[tuple[int, int, np.ndarray, float]]:
    """(i, j, median log(colour_i / colour_j) (3,), pixels) of every pair of scenes that show a surface in common."""
    found = []
    for i, scene in enumerate(scenes):
        for j, other in enumerate(scenes):
            if i == j or scene.cameras is None or not overlapping(scene, other):
                continue
            cameras = _looking_at(scene.cameras, other.gaussians)
            samples = [_same_surface(scene, other, cameras[c]) for c in range(len(cameras))]
            ratios = np.concatenate(samples) if samples else np.zeros((0, 3))
            if len(ratios) >= _MIN_PIXELS:
                found.append((i, j, np.median(ratios, axis=0), float(len(ratios))))
    return found


def _looking_at(cameras: Cameras, gaussians: Gaussians) -> Cameras:
    """The few cameras that have most of the Gaussians' means in view."""
    share = share_in_view(cameras, gaussians.means)
    best = np.argsort(-share, kind="stable")[:_MAX_VIEWS]
    return cameras[best[share[best] > 0]].resized(_LONGEST_SIDE_PX)


def _same_surface(scene: PlacedScene, other: PlacedScene, camera: Cameras) -> np.ndarray:
    """(K, 3) log-ratios of colour at pixels where both scenes show one surface, neither black nor blown out."""
    a, b = render(scene.gaussians, camera), render(other.gaussians, camera)
    same = np.abs(a.depth[0] - b.depth[0]) < _MAX_DEPTH_RATIO * np.minimum(a.depth[0], b.depth[0])
    same &= (a.alpha[0] > _MIN_ALPHA) & (b.alpha[0] > _MIN_ALPHA)
    colours = np.stack([a.colour[0][same], b.colour[0][same]])
    usable = ((colours > _MIN_COLOUR) & (colours < _MAX_COLOUR)).all((0, 2))
    ratios: np.ndarray = np.log(colours[0][usable] / colours[1][usable])
    return ratios


def _solve(count: int, ratios: list[tuple[int, int, np.ndarray, float]], largest: float) -> np.ndarray:
    """Log-gains (count, 3) to add, so that ``gain_i - gain_j = -ratio_ij`` in the weighted least-squares sense."""
    normal, right = np.zeros((count, count)), np.zeros((count, 3))
    for i, j, ratio, weight in ratios:
        normal[[i, j], [i, j]] += weight
        normal[[i, j], [j, i]] -= weight
        right[i] -= weight * ratio
        right[j] += weight * ratio
    # The pseudo-inverse gives every group of tied scenes a mean of zero.
    return np.clip(np.linalg.pinv(normal, hermitian=True) @ right, -largest, largest)

"""Captures taken with different exposure and white balance, brought to one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmap.compare import Balance
from gsmap.compare.colours import FLOOR
from gsmap.geometry.sh import SH_C0, rgb_of_sh0, sh0_of_rgb
from gsmap.merge.placed import overlapping, share_in_view
from gsmap.render import render
from gsmap.types import Cameras, Gaussians, KeptPhoto, PlacedScene


@dataclass(frozen=True)
class Params:
    """How the exposures of two captures are compared.

    Args:
        views_per_pair: views of one capture, those that see most of the other, that are compared.
        longest_side_px: size of these views.
        min_pixels: with fewer that show one surface in both, nothing is known of the pair.
        same_surface: depths that differ by at most this share are one surface.
        min_opacity: alpha from which on a pixel shows a surface.
        darkest, brightest: colours outside this range (of [0, 1]) are black or blown out and say nothing.
        negligible_log_gain: where no gain's logarithm is larger, the captures are left as they are.
        largest_gain: no capture is made brighter or darker than by this factor.
    """

    views_per_pair: int = 6
    longest_side_px: int = 160
    min_pixels: int = 500
    same_surface: float = 0.05
    min_opacity: float = 0.95
    darkest: float = 0.05
    brightest: float = 0.95
    negligible_log_gain: float = 0.01
    largest_gain: float = 4.0


def balance_exposure(
    scenes: Sequence[PlacedScene], params: Params | None = None
) -> tuple[list[PlacedScene], np.ndarray]:
    """The scenes with one gain per scene and colour channel removed, and the log-gains (S, 3) that were added.

    Gains are the least-squares answer to the median log-ratios of colour wherever two captures show the same surface;
    their mean over scenes that are tied together is zero, so the brightness of the whole stays.
    """
    params = params or Params()
    log_gains = _solve(len(scenes), _ratios(scenes, params), np.log(params.largest_gain))
    if np.abs(log_gains).max(initial=0) < params.negligible_log_gain:
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


def _ratios(scenes: Sequence[PlacedScene], params: Params) -> list[tuple[int, int, np.ndarray, float]]:
    """(i, j, median log(colour_i / colour_j) (3,), pixels) of every pair of scenes that show a surface in common."""
    found = []
    for i, scene in enumerate(scenes):
        for j, other in enumerate(scenes):
            if i == j or scene.cameras is None or not overlapping(scene, other):
                continue
            cameras = _looking_at(scene.cameras, other.gaussians, params)
            samples = [_same_surface(scene, other, cameras[c], params) for c in range(len(cameras))]
            ratios = np.concatenate(samples) if samples else np.zeros((0, 3))
            if len(ratios) >= params.min_pixels:
                found.append((i, j, np.median(ratios, axis=0), float(len(ratios))))
    return found


def _looking_at(cameras: Cameras, gaussians: Gaussians, params: Params) -> Cameras:
    """The few cameras that have most of the Gaussians' means in view."""
    share = share_in_view(cameras, gaussians.means)
    best = np.argsort(-share, kind="stable")[: params.views_per_pair]
    return cameras[best[share[best] > 0]].resized(params.longest_side_px)


def _same_surface(scene: PlacedScene, other: PlacedScene, camera: Cameras, params: Params) -> np.ndarray:
    """(K, 3) log-ratios of colour at pixels where both scenes show one surface, neither black nor blown out."""
    a, b = render(scene.gaussians, camera), render(other.gaussians, camera)
    same = np.abs(a.depth[0] - b.depth[0]) < params.same_surface * np.minimum(a.depth[0], b.depth[0])
    same &= (a.alpha[0] > params.min_opacity) & (b.alpha[0] > params.min_opacity)
    colours = np.stack([a.colour[0][same], b.colour[0][same]])
    usable = ((colours > params.darkest) & (colours < params.brightest)).all((0, 2))
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

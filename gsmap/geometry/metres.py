"""Metres per unit of a frame, from what is known of the units of the scenes that lie in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from gsmap.types import Gaussians, ScenePose, Sim3
from gsmap.types.metre import KnownBy, Metre

PLAUSIBLE_M = (0.25, 4.0)
"""Estimated metres per scene unit between which a scene's own unit may be the metre."""

# Devices' metres are off by 1 to 3 percent, all captures of one device alike: many of them are no better than one.
_TOLD_SIGMA = 0.01  # of what a person measured: a tape is that good, and so is a look at where it was laid
_MEASURED_SIGMA = 0.02  # of captures that are said to be in metres
_SURVEYED_SIGMA = 0.02  # of a survey that goes before what people say
_ASSUMED_SIGMA = 0.03  # of an own unit that nobody said is the metre, if it is
_FACTOR = 2.0  # that a guess from the content is good to
_AGREE = 5.0  # sigmas by which units may differ that are one


@dataclass(frozen=True)
class SceneUnit:
    """What is known of the unit of one scene.

    Args:
        told: metres per unit that a person gave, or None.
        in_metres: whether it is said to be in metres.
        may_be_metres: nobody says, and from its content its unit may be the metre.
        guess_m: metres per unit guessed from its content, or None.
    """

    told: float | None = None
    in_metres: bool = False
    may_be_metres: bool = False
    guess_m: float | None = None


def metre_of(scenes: Sequence[tuple[SceneUnit, ScenePose]], surveyed: tuple[float, float] | None = None) -> Metre:
    """The metre of one component.

    What a person told of scenes goes before what captures are said to be in, that before what may be assumed, and that
    before what is guessed. Each scene gives metres per unit of the frame as those of its own unit by the scale of its
    pose; they are weighed by the variances of both.
    A solved scale moves a little with every capture, so what comes through one is rounded, and is 1 where nothing
    speaks against it: what is made in metres need not be made again for a digit that nobody knows.

    Args:
        scenes: all of the component, each with its pose in it.
        surveyed: metres per unit of the frame and the standard deviation of the logarithm, from control points,
            positions or scale bars; goes before all else unless a person's word is better.
    """
    if surveyed is not None and surveyed[1] <= _SURVEYED_SIGMA:
        return _rounded(*surveyed)
    told = [(unit.told, pose) for unit, pose in scenes if unit.told is not None]
    if told:
        return _combined(told, _TOLD_SIGMA, "told")
    measured = [(1.0, pose) for unit, pose in scenes if unit.in_metres]
    if measured:
        return _combined(measured, _MEASURED_SIGMA, "measured")
    guesses = [np.log(unit.guess_m / pose.S_map_scene.scale) for unit, pose in scenes if unit.guess_m is not None]
    guess = float(np.exp(np.median(guesses))) if guesses else None
    metric = _agreeing([pose for unit, pose in scenes if unit.may_be_metres])
    if metric:
        return _assumed(_combined([(1.0, pose) for pose in metric], _ASSUMED_SIGMA, "assumed"), guess)
    if guess is None:
        return Metre(note=f"nothing tells how long a metre is in it: {_TELL}")
    # Steps of half an octave: another capture's guess does not move everything.
    rounded = float(2.0 ** (np.round(2 * np.log2(guess)) / 2))
    note = f"its metre is guessed, lengths may be off by a factor of {_FACTOR:g}: {_TELL}"
    return Metre(rounded, float(np.log(_FACTOR)), "guessed", note)


_TELL = "gsmap edit MAP SCENE --metres-per-unit X tells"


def _rounded(metres_per_unit: float, sigma: float) -> Metre:
    """A surveyed metre: to four digits, so that what is made in metres stays as it is for what a solve adds."""
    return Metre(float(f"{metres_per_unit:.4g}"), max(sigma, 5e-4), "surveyed", "")


def _combined(units: Sequence[tuple[float, ScenePose]], own_sigma: float, known_by: KnownBy) -> Metre:
    """Metres per unit of the frame from metres per unit of scenes that are good to ``own_sigma`` each."""
    logs = np.log([metres / pose.S_map_scene.scale for metres, pose in units])
    sigmas = np.sqrt([own_sigma**2 + _scale_variance(pose) for _, pose in units])
    weights = sigmas**-2.0
    log = float(weights @ logs / weights.sum())
    sigma = max(own_sigma, float(weights.sum() ** -0.5))
    note = ""
    if len(logs) > 1:
        sigma *= max(1.0, float(np.sqrt(weights @ (logs - log) ** 2 / (len(logs) - 1))))
        if np.abs((logs - log) / sigmas).max() > _AGREE / np.sqrt(2):
            note = f"captures disagree on the metre by {100 * float(np.ptp(logs)):.2g} %: {_TELL} which is right"
    if len({metres for metres, _ in units}) == 1 and all(pose.S_map_scene.scale == 1.0 for _, pose in units):
        return Metre(units[0][0], sigma, known_by, note)  # to the last digit
    if known_by != "told" and abs(log) <= sigma:
        return Metre(1.0, sigma, known_by, note)
    return Metre(float(f"{np.exp(log):.3g}"), sigma, known_by, note)


def _assumed(metre: Metre, guess: float | None) -> Metre:
    """An assumed metre; where the content says something else, the doubt covers both."""
    off = 0.0 if guess is None else abs(float(np.log(guess / metre.metres_per_unit)))
    if guess is None or off <= np.log(_FACTOR):
        return metre
    note = (
        f"its unit is taken for {metre.metres_per_unit:.3g} m since nobody said otherwise, though its captures look as "
        f"if it were about {guess:.2g} m: {_TELL}"
    )
    return replace(metre, sigma=off, note=note)


def _agreeing(poses: Sequence[ScenePose]) -> list[ScenePose]:
    """Those of the poses whose scenes have one unit, if they are more than half; else none: at most one unit of several
    is the metre, and nobody knows which."""
    if not poses:
        return []
    logs = np.log([pose.S_map_scene.scale for pose in poses])
    own = np.array([_scale_variance(pose) for pose in poses])

    def reach(i: int | slice, of_other: np.ndarray | float) -> np.ndarray:
        out: np.ndarray = _AGREE * np.sqrt(2 * _ASSUMED_SIGMA**2 + own[i] + of_other)
        return out

    # What lies within the least reach agrees whatever the other's variance, and what lies beyond the most does not. So
    # few pairs are looked at one by one, and a map may have ten thousand scenes.
    order = np.argsort(logs, kind="stable")
    inside, maybe = (
        [np.searchsorted(logs[order], logs + sign * reach(slice(None), spread), side) for sign, side in _ENDS]
        for spread in (own.min(), own.max())
    )
    counts = inside[1] - inside[0]
    for i in np.flatnonzero((maybe[0] < inside[0]) | (maybe[1] > inside[1])).tolist():
        others = np.r_[order[maybe[0][i] : inside[0][i]], order[inside[1][i] : maybe[1][i]]]
        counts[i] += int((np.abs(logs[others] - logs[i]) <= reach(i, own[others])).sum())
    i = int(counts.argmax())
    near = np.flatnonzero(np.abs(logs - logs[i]) <= reach(i, own))
    return [poses[k] for k in near.tolist()] if 2 * len(near) > len(poses) else []


_ENDS: tuple[tuple[int, Literal["left", "right"]], ...] = ((-1, "left"), (1, "right"))


def _scale_variance(pose: ScenePose) -> float:
    """Of the logarithm of its scale; 0 where nobody knows."""
    return 0.0 if pose.covariance is None else max(0.0, float(pose.covariance[6, 6]))


# --- a stage is entered in metres, and left in the map's unit ---------------------------------------------------------


def in_metres(S_map_scene: Sim3, metres_per_unit: float) -> Sim3:
    """Where a scene lies in the map's frame with its unit made the metre: the same axes and origin."""
    if metres_per_unit == 1.0:
        return S_map_scene
    return Sim3(S_map_scene.rotation, S_map_scene.translation * metres_per_unit, S_map_scene.scale * metres_per_unit)


def resized(gaussians: Gaussians, factor: float) -> Gaussians:
    """Gaussians of a frame in another unit, of which ``factor`` make one of the old; the same bits where it is 1."""
    if factor == 1.0:
        return gaussians
    means = (gaussians.means.astype(np.float64) * factor).astype(np.float32)
    return replace(gaussians, means=means, log_scales=gaussians.log_scales + np.float32(np.log(factor)))

"""Estimate the metric scale of a component from the units of its scenes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from gsmap.types import Gaussians, ScenePose, Sim3
from gsmap.types.metric_scale import KnownBy, MetricScale

PLAUSIBLE_M = (0.25, 4.0)
"""Range of estimated metres per scene unit in which the scene's unit may be the metre."""

# The metres of a device are off by 1 to 3 percent, equally in all its captures, so the errors do not average out.
_SPECIFIED_SIGMA = 0.01  # log sigma of a length that a person measured with a tape
_MEASURED_SIGMA = 0.02  # log sigma of captures in metres
_SURVEYED_SIGMA = 0.02  # largest log sigma of a survey that takes precedence over specified values
_ASSUMED_SIGMA = 0.03  # log sigma of a unit that is assumed to be the metre
_FACTOR = 2.0  # an estimate from the content is accurate to this factor
_AGREE = 5.0  # largest difference of equal units, in sigmas


@dataclass(frozen=True)
class SceneUnit:
    """Unit of a scene.

    Args:
        specified: metres per unit specified by the user, or None.
        in_metres: the scene is in metres.
        may_be_metres: the unit is not specified, and by the scene's content it may be the metre.
        guess_m: metres per unit estimated from the content, or None.
    """

    specified: float | None = None
    in_metres: bool = False
    may_be_metres: bool = False
    guess_m: float | None = None


def estimate_metric_scale(
    scenes: Sequence[tuple[SceneUnit, ScenePose]], surveyed: tuple[float, float] | None = None
) -> MetricScale:
    """Estimate the metric scale of one component.

    Specified values take precedence over captures in metres, these over assumed metres, and these over estimates from
    the content. The unit of each scene and the scale of its pose give metres per unit of the frame, weighted by the
    variances of both. A solved scale changes a little with every capture. Therefore the result is rounded, and it is 1
    if 1 is within its error, so that results in metres stay valid when only insignificant digits change.

    Args:
        scenes: all scenes of the component, with their poses in it.
        surveyed: metres per unit of the frame and the standard deviation of the logarithm, from control points,
            positions or scale bars. It takes precedence over everything else; if the standard deviation exceeds
            ``_SURVEYED_SIGMA``, only over assumptions and estimates that are less precise.
    """
    if surveyed is not None and surveyed[1] <= _SURVEYED_SIGMA:
        return _rounded(*surveyed)
    specified = [(unit.specified, pose) for unit, pose in scenes if unit.specified is not None]
    if specified:
        return _combined(specified, _SPECIFIED_SIGMA, "told")
    measured = [(1.0, pose) for unit, pose in scenes if unit.in_metres]
    if measured:
        return _combined(measured, _MEASURED_SIGMA, "measured")
    estimate = _estimated(scenes)
    return _rounded(*surveyed) if surveyed is not None and surveyed[1] < estimate.sigma else estimate


def _estimated(scenes: Sequence[tuple[SceneUnit, ScenePose]]) -> MetricScale:
    """Estimate the metric scale of a component of which nobody specified or measured a length."""
    guesses = [np.log(unit.guess_m / pose.S_map_scene.scale) for unit, pose in scenes if unit.guess_m is not None]
    guess = float(np.exp(np.median(guesses))) if guesses else None
    metric = _majority([pose for unit, pose in scenes if unit.may_be_metres])
    if metric:
        return _assumed(_combined([(1.0, pose) for pose in metric], _ASSUMED_SIGMA, "assumed"), guess)
    if guess is None:
        return MetricScale(note=f"its metric scale is unknown: {_SET_IT}")
    # Round to half an octave, so that the estimate from one more capture does not move everything.
    rounded = float(2.0 ** (np.round(2 * np.log2(guess)) / 2))
    note = f"its metric scale is estimated and may be off by a factor of {_FACTOR:g}: {_SET_IT}"
    return MetricScale(rounded, float(np.log(_FACTOR)), "guessed", note)


_SET_IT = "set it with gsmap edit MAP SCENE --metres-per-unit X"


def _rounded(metres_per_unit: float, sigma: float) -> MetricScale:
    """Round a surveyed metric scale to four digits, so that results in metres remain valid after another solve."""
    return MetricScale(float(f"{metres_per_unit:.4g}"), max(sigma, 5e-4), "surveyed", "")


def _combined(units: Sequence[tuple[float, ScenePose]], own_sigma: float, known_by: KnownBy) -> MetricScale:
    """Combine the metres per unit of scenes, each with the standard deviation ``own_sigma``, to that of the frame."""
    logs = np.log([metres / pose.S_map_scene.scale for metres, pose in units])
    sigmas = np.sqrt([own_sigma**2 + _scale_variance(pose) for _, pose in units])
    weights = sigmas**-2.0
    log = float(weights @ logs / weights.sum())
    sigma = max(own_sigma, float(weights.sum() ** -0.5))
    note = ""
    if len(logs) > 1:
        sigma *= max(1.0, float(np.sqrt(weights @ (logs - log) ** 2 / (len(logs) - 1))))
        if np.abs((logs - log) / sigmas).max() > _AGREE / np.sqrt(2):
            note = f"metric scales of captures differ by {100 * float(np.ptp(logs)):.2g} %: {_SET_IT}"
    if len({metres for metres, _ in units}) == 1 and all(pose.S_map_scene.scale == 1.0 for _, pose in units):
        return MetricScale(units[0][0], sigma, known_by, note)  # exactly as specified
    if known_by != "told" and abs(log) <= sigma:
        return MetricScale(1.0, sigma, known_by, note)
    return MetricScale(float(f"{np.exp(log):.3g}"), sigma, known_by, note)


def _assumed(metre: MetricScale, guess: float | None) -> MetricScale:
    """Increase the standard deviation of an assumed metre if the estimate from the content disagrees."""
    off = 0.0 if guess is None else abs(float(np.log(guess / metre.metres_per_unit)))
    if guess is None or off <= np.log(_FACTOR):
        return metre
    note = (
        f"its unit is assumed to be {metre.metres_per_unit:.3g} m, but by the content of its captures it is about "
        f"{guess:.2g} m: {_SET_IT}"
    )
    return replace(metre, sigma=off, note=note)


def _majority(poses: Sequence[ScenePose]) -> list[ScenePose]:
    """Return the poses of scenes with the same unit if these are the majority, otherwise none: only one of several
    units can be the metre."""
    if not poses:
        return []
    logs = np.log([pose.S_map_scene.scale for pose in poses])
    own = np.array([_scale_variance(pose) for pose in poses])

    def reach(i: int | slice, of_other: np.ndarray | float) -> np.ndarray:
        out: np.ndarray = _AGREE * np.sqrt(2 * _ASSUMED_SIGMA**2 + own[i] + of_other)
        return out

    # Scales within the smallest tolerance agree whatever the variance, and scales beyond the largest do not. So few
    # pairs are tested one by one; a map may have ten thousand scenes.
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
    """Return the variance of the logarithm of a pose's scale; 0 if it is unknown."""
    return 0.0 if pose.covariance is None else max(0.0, float(pose.covariance[6, 6]))


# --- conversion between the map's unit and metres ---------------------------------------------------------


def in_metres(S_map_scene: Sim3, metres_per_unit: float) -> Sim3:
    """Convert a scene's pose from the map's unit to metres; axes and origin do not change."""
    if metres_per_unit == 1.0:
        return S_map_scene
    return Sim3(S_map_scene.rotation, S_map_scene.translation * metres_per_unit, S_map_scene.scale * metres_per_unit)


def scale_gaussians(gaussians: Gaussians, factor: float) -> Gaussians:
    """Multiply positions and sizes of Gaussians by ``factor``, the number of new units per old unit."""
    if factor == 1.0:
        return gaussians
    means = (gaussians.means.astype(np.float64) * factor).astype(np.float32)
    return replace(gaussians, means=means, log_scales=gaussians.log_scales + np.float32(np.log(factor)))

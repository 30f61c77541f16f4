"""Data snooping (Baarda 1968): solve least squares without the observations that contradict the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gsmap.geometry.chi_square import chi2_quantile
from gsmap.optimize.survey_common_points import MAX_LOG_SCALE_SIGMA, MAX_ROTATION_SIGMA_DEG
from gsmap.optimize.survey_report import world_covariance
from gsmap.optimize.survey_system import GATE_PROBABILITY, Active, Factor, ObservationTests, System
from gsmap.optimize.survey_terms import Terms, Unknowns

MAX_ROUNDS = 50  # number of times that the worst observation is left out and the system solved again


def initial_points(system: System, x: Unknowns) -> np.ndarray:
    """Return points (K, 3): check points are triangulated from photos, all other points stay as they are."""
    met, _, determined = system.terms.triangulate(x, np.ones(len(system.terms.images), dtype=bool))
    return np.where((determined & system.is_check)[:, None], met, x.points)


def exclude_outliers(system: System, x: Unknowns, allowed: Active, gross: Active) -> tuple[Unknowns, Active]:
    """Solve without outliers: after graduated non-convexity (Geman-McClure), repeatedly exclude the worst observation
    or readmit an observation that fits.

    Args:
        allowed: observations that may be used.
        gross: allowed observations that are left out at the start.
    """
    active: Active = tuple(use & ~bad for use, bad in zip(allowed, gross, strict=True))  # type: ignore[assignment]
    x = system.fit(replace(x, points=system.points_at(x, active)), system.as_weights(active), max_steps=3)
    bars = [chi2_quantile(GATE_PROBABILITY, t.residuals.shape[1]) for t in system.terms.observations(x)]
    wide = max((float((t.squares[a] / b).max(initial=0)) for t, a, b in _seen(system, x, active, bars)), default=1.0)
    while True:
        for _ in range(3):
            weights: Active = tuple(  # type: ignore[assignment]
                a * (wide * b / (wide * b + t.squares)) ** 2 for t, a, b in _seen(system, x, active, bars)
            )
            x = system.fit(x, weights, max_steps=2)
        if wide <= 1:
            break
        wide = max(1.0, wide / 4)
    active = tuple(a & (t.squares < 4 * b) & t.valid for t, a, b in _seen(system, x, active, bars))  # type: ignore[assignment]
    failures = [np.zeros(len(a), dtype=np.int64) for a in active]
    for _ in range(MAX_ROUNDS):
        x = system.fit(replace(x, points=system.points_at(x, active)), system.as_weights(active))
        tests = system.tests(x, active, system.factor(x, system.as_weights(active)))
        if not _exchange(system, active, allowed, tests, failures):
            break
    return x, active


def _seen(system: System, x: Unknowns, active: Active, bars: Sequence[float]) -> list[tuple[Terms, np.ndarray, float]]:
    return list(zip(system.terms.observations(x), active, bars, strict=True))


def _exchange(
    system: System, active: Active, allowed: Active, tests: ObservationTests, failures: list[np.ndarray]
) -> bool:
    """Exclude the observation that contradicts the rest most, or readmit one that fits; return whether any changed."""
    worst, place = 0.0, None
    alpha = np.log(1 - GATE_PROBABILITY)
    for kind, (use, log_p) in enumerate(zip(active, tests.log_p, strict=True)):
        for k in np.flatnonzero(use & (log_p < alpha)).tolist():
            # If observations are equivalent, the survey of the point is excluded first: points come first.
            if log_p[k] < worst - 1e-6 * abs(worst) - 1e-9 and not (kind == 1 and system.lone[k]):
                worst, place = float(log_p[k]), (kind, k)
    if place is not None:
        active[place[0]][place[1]] = False
        failures[place[0]][place[1]] += 1
        return True
    for kind, (use, log_p) in enumerate(zip(active, tests.log_p, strict=True)):
        back = allowed[kind] & ~use & (log_p > alpha) & (failures[kind] < 2)
        if back.any():
            first = int(np.flatnonzero(back)[np.argmax(log_p[back])])
            use[first] = True
            failures[kind][first] += 1
            return True
    return False


def describe_weakness(system: System, factor: Factor) -> str:
    """Describe the directions that a solution leaves undetermined; empty if there are none."""
    covariance = world_covariance(system, factor)
    values, axes = np.linalg.eigh(covariance[:3, :3])
    turn = float(np.degrees(np.sqrt(max(0.0, values[-1]))))
    if turn > MAX_ROTATION_SIGMA_DEG:
        axis = ", ".join(f"{v:.2f}" for v in axes[:, -1])
        return (
            f"rotation about the map's axis ({axis}) is not determined (standard deviation {turn:.2g} deg): add "
            "control points or positions far from that axis"
        )
    if np.sqrt(covariance[6, 6]) > MAX_LOG_SCALE_SIGMA:
        return (
            f"scale is not determined (standard deviation {100 * np.sqrt(covariance[6, 6]):.2g} %): add control "
            "points or positions further apart, or a scale bar"
        )
    return ""

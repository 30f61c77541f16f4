"""Estimate the common shift of a group of observations against the rest of a solution, and its likely causes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.geometry.chi_square import chi2_log_survival, chi2_quantile
from gsmap.optimize.survey_common_points import CommonPoints
from gsmap.optimize.survey_system import GATE_PROBABILITY, MIN_REDUNDANCY, Factor, System
from gsmap.optimize.survey_terms import Terms
from gsmap.types.world import Contradiction, WorldFrame

FEET = 0.3048
GEOID_M = 110.0  # the geoid is between 107 m below and 86 m above the ellipsoid
_EARTH_M = 6_371_000.0
_SITE_M = 10.0  # largest height difference between take-off and the marks of a site
_FLOWN_M = 150.0  # largest height of a drone above take-off

GROUPS = {"points": "control points", "photos": "photos", "scenes": "surveyed scenes", "bars": "scale bars"}
_REASONS = {
    "altitude_zero": "their altitudes are 0, so the device did not measure them",
    "feet": "feet taken for metres",
    "above_takeoff": "heights above take-off",
    "height_system": "ellipsoidal against orthometric heights",
    "vertical_shift": "no known reason",
    "horizontal_shift": "another datum, or photos of another flight",
    "shape": "they are of another flight or place, or far less precise than stated",
    "scale": "another unit of length",
    "split": "they contradict each other",
}


@dataclass(frozen=True, eq=False)
class CommonShift:
    """The common shift of some points against a solution.

    Args:
        shift_m: (3,) measured minus predicted position.
        covariance: (3, 3) covariance of the shift with all common errors; unbounded in directions that nothing checks.
        log_p: logarithm of the probability that chance causes a shift as large.
        agree: (n,) mask of the points that share the shift.
        shaped: the relative positions of the points match the map.
    """

    shift_m: np.ndarray
    covariance: np.ndarray
    log_p: float
    agree: np.ndarray
    shaped: bool = True


def estimate_shift(
    system: System, all_terms: Sequence[Terms], factor: Factor, places: CommonPoints, *, used: bool
) -> CommonShift:
    """Estimate the shift that some points have in common.

    Args:
        all_terms: terms of points, images, fixes and bars at the same estimate as ``factor``.
        places: all control points, or all fixes.
        used: the solution uses these points. Then their own contribution is removed (Baarda 1968, with one alternative
            hypothesis for all of them); otherwise they are predicted.
    """
    terms = all_terms[0 if places.kinds[0] == "points" else 2]
    weights = 1 / places.own_m
    r = terms.residuals[places.rows]
    apart = -r / weights
    agree = np.ones(len(places), dtype=bool)
    if not used and len(places) > 2:
        far = np.linalg.norm((apart - np.median(apart, axis=0)) * weights, axis=1)
        agree = far <= max(5.0, 4 * float(np.median(far)))
    mine, W, r = places.rows[agree], weights[agree], r[agree]
    own = (W**2).sum(0)
    crossed = _crossed(terms, mine, W, system.size)
    V = crossed.T @ factor.solve(crossed)
    V = (V + V.T) / 2
    b = -(W * r).sum(0)
    if not used:
        shift, covariance = b / own, (np.diag(own) + V) / own / own[:, None]
        log_p = float(chi2_log_survival(shift @ np.linalg.solve(covariance, shift), 3))
        return CommonShift(shift, covariance, log_p, agree, _shaped(system, factor, terms, mine, apart[agree], W, own))
    root = np.sqrt(own)
    values, axes = np.linalg.eigh((np.diag(own) - V) / root / root[:, None])
    checked = values > MIN_REDUNDANCY
    along = axes.T @ (b / root)
    shift = (axes[:, checked] @ (along[checked] / values[checked])) / root
    spread = np.where(checked, 1 / np.maximum(values, 1e-300), 1e12)
    covariance = (axes * spread) @ axes.T / root / root[:, None]
    statistic = float((along[checked] ** 2 / values[checked]).sum())
    log_p = float(chi2_log_survival(statistic, int(checked.sum()))) if checked.any() else 0.0
    return CommonShift(shift, covariance, log_p, agree)


def _crossed(terms: Terms, rows: np.ndarray, W: np.ndarray, size: int) -> np.ndarray:
    """Compute the derivatives (size, 3) of all columns with respect to a shift of some measured positions."""
    out = np.zeros((size, 3))
    for first, J in terms.parts:
        there = first[rows] >= 0
        some = rows[there]
        at = first[some][:, None] + np.arange(J.shape[2])
        # A residual is prediction minus measurement, so a shift of the measurement lowers it.
        np.add.at(out, at, np.einsum("gmw,gm->gwm", J[some], W[there]))
    return out


def _shaped(
    system: System, factor: Factor, terms: Terms, rows: np.ndarray, apart: np.ndarray, W: np.ndarray, own: np.ndarray
) -> bool:
    """Return whether the relative positions of some points match the map, within the errors of both."""
    gate = chi2_quantile(GATE_PROBABILITY, 3)
    mean = (W**2 * apart).sum(0) / own
    if len(rows) < 3 or np.median((((apart - mean) * W) ** 2).sum(1)) <= gate:
        return True
    some = np.linspace(0, len(rows) - 1, min(len(rows), 64)).astype(int)
    J = Terms(
        terms.kind,
        terms.residuals[rows],
        tuple((first[rows], J[rows]) for first, J in terms.parts),
        terms.valid[rows],
    ).rows(system.size)
    J = J / W[:, :, None]
    J = J - np.einsum("gm,gmw->mw", W**2 / own, J)
    statistics = []
    for k in some.tolist():
        covariance = np.diag(W[k] ** -2) + J[k] @ factor.solve(J[k].T)
        statistics.append((apart[k] - mean) @ np.linalg.solve(covariance, apart[k] - mean))
    return bool(np.median(statistics) <= gate)


def altitudes(frame: WorldFrame, positions: np.ndarray) -> np.ndarray:
    """Compute the (N,) heights of positions (N, 3) in the world frame above the reference surface of the frame's
    origin."""
    out: np.ndarray = positions[:, 2] + frame.height_m + (positions[:, :2] ** 2).sum(1) / (2 * _EARTH_M)
    return out


def is_unmeasured(places: CommonPoints, frame: WorldFrame) -> bool:
    """Return whether the altitudes of photos are all 0, which means that the device did not measure them."""
    return len(places) >= 3 and bool((np.abs(altitudes(frame, places.in_world)) < 0.02).all())


def cluster_shifts(shifts: Sequence[CommonShift], probability: float) -> list[np.ndarray]:
    """Cluster shifts that agree with each other, the largest cluster first."""
    left, out = list(range(len(shifts))), []
    gate = chi2_quantile(probability, 3)
    while left:
        best: list[int] = []
        for k in left:
            near = [j for j in left if _agree(shifts[k], shifts[j], gate)]
            best = near if len(near) > len(best) else best
        out.append(np.array(best, dtype=np.int64))
        left = [k for k in left if k not in best]
    return sorted(out, key=len, reverse=True)


def _agree(a: CommonShift, b: CommonShift, gate: float) -> bool:
    off = a.shift_m - b.shift_m
    slack = (0.05 * max(np.abs(a.shift_m).max(), np.abs(b.shift_m).max())) ** 2
    return bool(off @ np.linalg.solve(a.covariance + b.covariance + slack * np.eye(3), off) < gate)


def average_shifts(shifts: Sequence[CommonShift]) -> CommonShift:
    """Average shifts that agree. The average is as uncertain as the best shift, because their errors are shared."""
    best = min(shifts, key=lambda one: float(np.trace(one.covariance)))
    mean = np.mean([one.shift_m for one in shifts], axis=0)
    return CommonShift(
        mean, best.covariance, min(one.log_p for one in shifts), best.agree, all(one.shaped for one in shifts)
    )


def likely_causes(
    places: CommonPoints, shift: CommonShift, frame: WorldFrame, ground_m: np.ndarray | None
) -> tuple[str, ...]:
    """List causes that explain a shift, the likeliest first, if these points are wrong and the reference is correct.

    Args:
        ground_m: altitudes of marks on the ground, or None if there are none.
    """
    if not shift.shaped:
        return ("shape",)
    sigmas = np.sqrt(np.diag(shift.covariance))
    across, up = float(np.linalg.norm(shift.shift_m[:2])), float(shift.shift_m[2])
    horizontal = across > 3.5 * float(sigmas[:2].max())
    vertical = abs(up) > 3.5 * float(sigmas[2])
    out = list(_heights(places, up, sigmas[2], frame, ground_m)) if vertical or not horizontal else []
    if horizontal:
        out = ["horizontal_shift", *out] if across > abs(up) or not vertical else [*out, "horizontal_shift"]
    return tuple(out)


def _heights(
    places: CommonPoints, up: float, sigma_m: float, frame: WorldFrame, ground_m: np.ndarray | None
) -> tuple[str, ...]:
    own = altitudes(frame, places.in_world)
    if len(places) >= 2 and np.abs(own).max() < 0.5:
        return ("altitude_zero",)
    height, sea = float(np.mean(own)), float(np.median(places.sea_m))
    true, out = height - up, []
    common = np.sqrt(max(sigma_m**2 - sea**2, 0.0))
    bar = 3 * sigma_m / FEET + 0.5 + 0.5 * float(np.std(own))
    if abs(height - true / FEET) < bar < abs(up):
        out.append("feet")
    if set(places.kinds.tolist()) == {"photos"} and up < 0:
        lowest, highest = (true - _FLOWN_M, true) if ground_m is None else (ground_m.min(), ground_m.max())
        slack = _SITE_M + 3 * common
        flown = -up > GEOID_M + 3 * common and -_FLOWN_M / 5 < height < _FLOWN_M
        if flown or lowest - slack < -up < highest + slack:
            out.append("above_takeoff")
    if abs(up) <= GEOID_M + 3 * common:
        out.append("height_system")
    return tuple(dict.fromkeys(out)) or ("vertical_shift",)


def describe_contradiction(
    places: CommonPoints, scenes: Sequence[str], shift: CommonShift, against: str, why: tuple[str, ...], kept: str
) -> Contradiction:
    """Build the record of a group of points that contradicts other observations.

    Args:
        scenes: ids of the scenes to which the points belong.
    """
    group, n = str(places.kinds[0]), len(places)
    size = [float(v) for v in shift.shift_m]
    sigma = [float(v) for v in np.sqrt(np.diag(shift.covariance))]
    across, up = float(np.linalg.norm(size[:2])), size[2]
    way = f"{abs(up):.4g} m {'above' if up > 0 else 'below'}"
    if across > abs(up):
        way = f"{across:.4g} m beside"
    known = sigma[2] if across <= abs(up) else max(sigma[:2])
    of = f" of {len(set(scenes))} captures" if group == "photos" else ""
    other = "where others of them put them" if group == against else f"where the {GROUPS[against]} put them"
    text = f"{n} {GROUPS[group]}{of} lie {way} {other} (standard deviation {known:.2g} m): {format_causes(why)}"
    return Contradiction(
        group, against, why[0], tuple(why[1:]), kept, tuple(size), tuple(sigma), None, n, tuple(sorted(set(scenes))),
        text,
    )  # fmt: skip


def format_causes(why: Sequence[str]) -> str:
    """Format the likely causes, as a question if they are guesses."""
    return ", or ".join(_REASONS[one] for one in why) + ("" if why[0] in ("vertical_shift", "split") else "?")

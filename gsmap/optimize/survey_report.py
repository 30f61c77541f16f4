"""Report the residuals of observations, and the georeference of a component."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from gsmap.geometry.chi_square import chi2_quantile
from gsmap.optimize.survey_system import GATE_PROBABILITY, Active, Factor, ObservationTests, System
from gsmap.optimize.survey_terms import Terms, Unknowns
from gsmap.reason_codes import reason
from gsmap.types.world import Contradiction, Georeference, Residual, Survey, WorldFrame

_MIN_CHECKS = 2.5  # below this redundancy of points, fixes and bars a note warns of unchecked observations
_CONTRADICTS = reason("contradicts_observations", "it contradicts the other observations")
_BARS_CONTRADICT = reason("contradicts_observations", "the other scale bars contradict it")
_NO_RAY = reason("no_ray", "no two photos show it, and the photo that shows it has no rendered surface there")


@dataclass(frozen=True, eq=False)
class Solution:
    """A georeferenced component.

    Args:
        active: observations that the solution uses.
        contradictions: groups that were left out, or observations that contradict each other undecidedly.
        reasons: contradiction that left out an observation, by (kind, row) of the observation.
    """

    x: Unknowns
    active: Active
    factor: Factor
    contradictions: tuple[Contradiction, ...] = ()
    reasons: dict[tuple[str, int], str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class SurveyFailure:
    """Reason why a component is not georeferenced.

    Args:
        problem: observations that are missing, or that contradict each other.
        code: key of `gsmap.types.world.PROBLEMS`.
        contradictions: groups that contradict each other.
    """

    problem: str
    code: str
    contradictions: tuple[Contradiction, ...] = ()


def active_observations(system: System, tie: Georeference) -> Active:
    """Return the observations that a stored answer used."""
    out = tie.left_out()
    terms = system.terms
    names = (
        [("point", p.name, "") for p in terms.points],
        [("image", f"{i.point} in {i.image}", i.scene) for i in terms.images],
        [("fix", f.name, f.scene) for f in terms.fixes],
        [("bar", b.name, b.scenes[0]) for b in terms.bars],
    )
    points, images, fixes, bars = (
        np.array([name not in out for name in some], dtype=bool) & use
        for some, use in zip(names, system.usable, strict=True)
    )
    return points, images, fixes, bars


def build_world_tie(system: System, solved: Solution, index: int, frame: WorldFrame | None) -> Georeference:
    """Build the georeference of a component with all residuals."""
    x, active, factor = solved.x, solved.active, solved.factor
    tests = system.tests(x, active, factor)
    rows = _point_rows(system, solved, tests)
    rows += _image_rows(system, x, active, tests) + _fix_rows(system, solved, tests) + _bar_rows(system, solved, tests)
    covariance = world_covariance(system, factor)
    factor_of = _variance_factor(system, x, active, tests)
    notes = []
    if factor_of > 1:
        notes.append(
            f"observations and edges disagree by {np.sqrt(factor_of):.2g} times their stated errors; the "
            "covariance is scaled accordingly"
        )
    if sum(float(tests.redundancies[kind].sum()) for kind in (0, 2, 3)) < _MIN_CHECKS:
        notes.append("these observations hardly check each other: a blunder in one of them could not be detected")
    world = x.world.item(0)
    return Georeference(
        index,
        world,
        covariance * factor_of,
        world.scale,
        notes=tuple(notes),
        scale_sigma=float(np.sqrt(covariance[6, 6] * factor_of)),
        frame=frame,
        residuals=tuple(rows),
        contradictions=solved.contradictions,
        variance_factor=factor_of,
    )


def tie_by_bars(system: System, index: int, survey: Survey, failure: SurveyFailure) -> Georeference:
    """Build a georeference from scale bars alone if positions do not suffice: it determines the metric scale only."""
    terms, missing = system.terms, failure.problem
    nothing = Georeference(
        index, frame=survey.frame, problem=missing, problem_code=failure.code, contradictions=failure.contradictions
    )
    rows = [Residual("point", p.name, "", "check" if p.check else "unused", reason=missing) for p in terms.points]
    rows += [Residual("fix", f.name, f.scene, "unused", reason=missing) for f in terms.fixes]
    if not terms.bars:
        return replace(nothing, residuals=tuple(rows))
    logs, variances = [], []
    for bar in terms.bars:
        poses = [system.scenes.item(terms._row[scene]) for scene in bar.scenes]
        across = float(np.linalg.norm(poses[0].apply(bar.points[0]) - poses[1].apply(bar.points[1])))
        picked = sum((s * pose.scale) ** 2 for s, pose in zip(bar.point_sigmas, poses, strict=True))
        logs.append(np.log(bar.length_m / across))
        variances.append((bar.sigma_m / bar.length_m) ** 2 + picked / across**2)
    log, use = _agreed(np.array(logs), np.array(variances), GATE_PROBABILITY)
    weights = use / np.array(variances)
    sigma = float(weights.sum() ** -0.5)
    free = int(use.sum()) - 1
    off = float((weights * (np.array(logs) - log) ** 2).sum())
    if free > 0 and off > chi2_quantile(GATE_PROBABILITY, free):
        sigma *= float(np.sqrt(off / free))
    for bar, one, variance, used in zip(terms.bars, logs, variances, use, strict=True):
        error = bar.length_m * (np.exp(log - one) - 1)
        rows.append(
            Residual(
                "bar", bar.name, bar.scenes[0], "used" if used else "outlier", (float(error),),
                (float(bar.length_m * np.sqrt(variance)),), reason="" if used else _BARS_CONTRADICT,
            )
        )  # fmt: skip
    return replace(nothing, metres_per_unit=float(np.exp(log)), scale_sigma=sigma, residuals=tuple(rows))


def world_covariance(system: System, factor: Factor) -> np.ndarray:
    """Compute the covariance (7, 7) of ``S_world_map``, where the pose of the anchor scene is taken as exact."""
    joint = factor.joint([system.own.anchor])
    back = system.scenes[np.array([system.own.anchor])]
    # For the product W X the steps of both add on the scene's side; then they are moved back to the map's side.
    to_scene, to_map = back.inverse().adjoint()[0], back.adjoint()[0]
    both = np.concatenate([to_scene, np.eye(7)], axis=1)
    out: np.ndarray = to_map @ both @ joint @ both.T @ to_map.T
    return out


def _variance_factor(system: System, x: Unknowns, active: Active, tests: ObservationTests) -> float:
    """Compute the variance factor of the used observations if chance does not explain their residuals; at least 1.

    It is the largest of all observations together and of each kind alone (points, images, fixes and bars), whose
    degrees of freedom are its redundancies (Foerstner 1979): many images that agree hide no points that do not.
    """
    terms = system.terms.observations(x)
    squares = [float(t.squares[a].sum()) for t, a in zip(terms, active, strict=True)]
    free = [float(one.sum()) for one in tests.redundancies]
    found = [1.0]
    for some in ((0,), (1,), (2,), (3,), (0, 1, 2, 3)):
        total, dof = sum(squares[kind] for kind in some), sum(free[kind] for kind in some)
        if dof >= 1 and total > chi2_quantile(GATE_PROBABILITY, int(np.ceil(dof))):
            found.append(total / dof)
    return max(found)


def _point_rows(system: System, solved: Solution, tests: ObservationTests) -> list[Residual]:
    x, active, factor = solved.x, solved.active, solved.factor
    show = active[1] | (system.is_check[system.terms.image_points] if len(system.terms.images) else active[1])
    met, picking, determined = system.terms.triangulate(x, show)
    at = replace(x, points=met)
    images = system.terms.observations(at)[1]
    rows = []
    for k, point in enumerate(system.terms.points):
        use = "check" if point.check else "used" if active[0][k] else "outlier"
        error: tuple[float, ...] = ()
        sigma: tuple[float, ...] = ()
        statistic, dof, why = _given(tests.statistics[0][k], tests.dofs[0][k]), int(tests.dofs[0][k]), ""
        if determined[k]:
            off = met[k] - point.position
            covariance = picking[k] + _carried(system, k, images, picking[k], factor, show)
            error = (float(off[0]), float(off[1]), float(off[2]))
            s = np.sqrt(np.maximum(0, np.diag(covariance)))
            sigma = (float(s[0]), float(s[1]), float(s[2]))
            if point.check:
                h, v = point.sigma_m
                statistic, dof = float(off @ np.linalg.solve(covariance + np.diag([h, h, v]) ** 2, off)), 3
        elif point.check or not active[0][k]:
            why = _NO_RAY
        if use == "outlier" and not why:
            why = solved.reasons.get(("point", k), _CONTRADICTS)
        rows.append(Residual("point", point.name, "", use, error, sigma, (), statistic, dof, why))
    return rows


def _carried(
    system: System, k: int, images: Terms, picking: np.ndarray, factor: Factor, show: np.ndarray
) -> np.ndarray:
    """Propagate the uncertainty of poses to a triangulated point; return a (3, 3) covariance."""
    mine = np.flatnonzero((system.terms.image_points == k) & show & images.valid)
    some = Terms(
        "image", images.residuals[mine], tuple((f[mine], J[mine]) for f, J in images.parts), images.valid[mine]
    )
    J = some.rows(system.size).reshape(-1, system.size)
    by_point = slice(system.terms.columns.points + 3 * k, system.terms.columns.points + 3 * k + 3)
    own = J[:, by_point].copy()
    J[:, by_point] = 0
    carry = -picking @ own.T @ J
    out: np.ndarray = carry @ factor.solve(carry.T)
    return (out + out.T) / 2


def _image_rows(system: System, x: Unknowns, active: Active, tests: ObservationTests) -> list[Residual]:
    checked = system.is_check[system.terms.image_points] if len(system.terms.images) else active[1]
    met, _, determined = system.terms.triangulate(x, active[1] | checked)
    points = np.where((determined & ~active[0])[:, None], met, x.points)
    errors = system.terms.image_errors_px(replace(x, points=points))
    rows = []
    for k, image in enumerate(system.terms.images):
        use = "check" if checked[k] else "used" if active[1][k] else "outlier"
        why = _CONTRADICTS if use == "outlier" else ""
        statistic = None if checked[k] or system.lone[k] else _given(tests.statistics[1][k], tests.dofs[1][k])
        error = (float(errors[k, 0]), float(errors[k, 1])) if abs(errors[k]).max() < 1e6 else ()
        rows.append(
            Residual(
                "image", f"{image.point} in {image.image}", image.scene, use, (), (), error, statistic,
                int(tests.dofs[1][k]), why,
            )
        )  # fmt: skip
    return rows


def _fix_rows(system: System, solved: Solution, tests: ObservationTests) -> list[Residual]:
    rows, x, active = [], solved.x, solved.active
    at = x.world.item(0).apply(system.terms.fix_points(x.scenes))
    for k, fix in enumerate(system.terms.fixes):
        use = "used" if active[2][k] else "outlier"
        off = at[k] - fix.position
        h, v = np.hypot(fix.sigma_m, fix.common_sigma_m)
        v = np.hypot(v, fix.sea_level_sigma_m)
        rows.append(
            Residual(
                "fix", fix.name, fix.scene, use, (float(off[0]), float(off[1]), float(off[2])),
                (float(h), float(h), float(v)), (), _given(tests.statistics[2][k], tests.dofs[2][k]),
                int(tests.dofs[2][k]), "" if active[2][k] else solved.reasons.get(("fix", k), _CONTRADICTS),
            )
        )  # fmt: skip
    return rows


def _bar_rows(system: System, solved: Solution, tests: ObservationTests) -> list[Residual]:
    rows, x, active = [], solved.x, solved.active
    terms = system.terms.observations(x)[3]
    for k, bar in enumerate(system.terms.bars):
        use = "used" if active[3][k] else "outlier"
        own = (system.terms._row[bar.scenes[0]], system.terms._row[bar.scenes[1]])
        ends = [x.scenes.item(row).apply(bar.points[e]) for e, row in enumerate(own)]
        length = float(np.linalg.norm(ends[0] - ends[1]) * np.exp(x.world.log_scales[0]))
        off = length - bar.length_m
        sigma = abs(off / terms.residuals[k, 0]) if terms.residuals[k, 0] else bar.sigma_m
        rows.append(
            Residual(
                "bar", bar.name, bar.scenes[0], use, (off,), (float(sigma),), (),
                _given(tests.statistics[3][k], tests.dofs[3][k]), int(tests.dofs[3][k]),
                "" if active[3][k] else solved.reasons.get(("bar", k), _CONTRADICTS),
            )
        )  # fmt: skip
    return rows


def _agreed(logs: np.ndarray, variances: np.ndarray, probability: float) -> tuple[float, np.ndarray]:
    """Average values that agree; of three or more, values far from the median are excluded. Also return which values
    were used."""
    use = np.ones(len(logs), dtype=bool)
    if len(logs) >= 3:
        use = (logs - np.median(logs)) ** 2 <= chi2_quantile(probability, 1) * (variances + np.median(variances))
    weights = use / variances
    return float((weights * logs).sum() / weights.sum()), use


def _given(value: float, dof: int) -> float | None:
    return float(value) if dof > 0 and np.isfinite(value) else None

"""A component tied to the world: scene poses, ``S_world_map`` and control points from edges and observations together.

The map's frame stays held as it was (by its anchor scene, or by priors), and ``S_world_map`` is free: so observations
bend the component where its edges leave room, and never move it as a whole. Everything is solved at once, by
Gauss-Newton on one sparse system, whose inverse then tests every observation against all others and gives covariances.
See docs/design/0037-the-world.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from gsmap.errors import InputError
from gsmap.geometry.similarities import Similarities
from gsmap.optimize.gtsam_solve import held_directions
from gsmap.optimize.measurements import all_rigid, measurements
from gsmap.optimize.params import Params, SurveyParams
from gsmap.optimize.priors import PriorTerms
from gsmap.optimize.survey_places import NOTHING, known_places
from gsmap.optimize.survey_report import active_of, lengths_only, report, world_covariance
from gsmap.optimize.survey_system import Active, Component, Factor, System, Tests
from gsmap.optimize.survey_terms import SurveyTerms, Terms, Unknowns
from gsmap.types import Edge, PoseGraph, Prior, Sim3
from gsmap.types.world import UNSOLVED, Survey, WorldFrame, WorldTie


@dataclass(frozen=True, eq=False)
class Surveyed:
    """A component solved with what was observed of the world.

    Args:
        poses: all scenes; those of other components as given.
        covariances: (n, 7, 7) of the component's scenes, in the map's frame; None where it stays as the edges have it.
        tie: where it lies.
    """

    poses: Similarities
    covariances: np.ndarray | None
    tie: WorldTie


def tie_component(
    whole: Component, poses: Similarities, survey: Survey, index: int, params: SurveyParams, marginal_scenes: int
) -> Surveyed | None:
    """Solve a component with its observations, from poses that its edges alone gave; None where it has none.

    Args:
        index: of the component.
        marginal_scenes: largest number of scenes for which covariances are computed.
    """
    own = whole.local()
    terms = SurveyTerms.of(survey, own.edges.scene_ids, own.dim)
    if not terms:
        return None
    system = System(own, terms, poses[whole.scenes], params)
    try:
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):  # what is not finite is caught below
            surveyed = _surveyed(system, whole, poses, survey, index, marginal_scenes)
    except (np.linalg.LinAlgError, RuntimeError, InputError):  # of numpy, a singular factor in scipy, and Sim3
        surveyed = None
    if surveyed is None or not _is_finite(surveyed):
        return Surveyed(poses, None, lengths_only(system, index, survey, UNSOLVED))
    return surveyed


def _surveyed(
    system: System, whole: Component, poses: Similarities, survey: Survey, index: int, marginal_scenes: int
) -> Surveyed:
    found = _solve(system, survey.frame)
    if isinstance(found, str):
        return Surveyed(poses, None, lengths_only(system, index, survey, found))
    x, active, factor = found
    tie = report(system, x, active, factor, index, survey.frame)
    covariances = factor.scene_covariances() if len(whole.scenes) <= marginal_scenes else None
    return Surveyed(poses.replaced(whole.scenes, x.scenes), covariances, tie)


def _is_finite(surveyed: Surveyed) -> bool:
    poses, tie = surveyed.poses, surveyed.tie
    numbers = [poses.rotations, poses.translations, poses.log_scales]
    if tie.S_world_map is not None and tie.covariance is not None:
        numbers += [tie.S_world_map.matrix(), tie.covariance]
    return all(bool(np.isfinite(one).all()) for one in numbers)


def joint_of_answer(
    answer: PoseGraph,
    edges: Sequence[Edge],
    priors: Sequence[Prior],
    survey: Survey,
    scenes: Sequence[str],
    component: int,
    params: Params,
) -> np.ndarray | None:
    """See `gsmap.optimize.joint_covariance`. Nothing is solved but for what the observations alone hold."""
    ids = sorted(scene for scene, pose in answer.poses.items() if pose.component == component)
    inside = set(ids)
    mine = [e for e in edges if {e.target, e.source} <= inside and answer.use(e.target, e.source) != "unused"]
    here = [prior for prior in priors if prior.scene in inside]
    here = [prior for prior in here if prior.scene not in answer.provenance.contradicted_priors]
    m = measurements(ids, mine, rigid=all_rigid(mine, here, answer))
    poses = Similarities.stack([answer.poses[scene].S_map_scene for scene in ids])
    rows, terms = np.arange(len(ids)), PriorTerms.stack(ids, here)
    # The scene that holds the frame is the one that is known best.
    sure = [answer.poses[scene].covariance for scene in ids]
    anchor = int(np.argmin([np.inf if c is None else float(np.trace(c)) for c in sure]))
    held = held_directions(m, poses, rows, anchor, terms, params.gauge)
    tie = answer.tie(component)
    tied = tie is not None and tie.S_world_map is not None
    own = SurveyTerms.of(survey if tied else Survey(), m.scene_ids, m.dim)
    system = System(Component(rows, m, terms, anchor, held), own, poses, params.survey)
    x = own.start(poses, tie.S_world_map if tie is not None and tie.S_world_map is not None else Sim3.identity())
    row = {scene: k for k, scene in enumerate(ids)}
    wanted = [row[scene] for scene in scenes]
    if tie is None or not tied:
        joint = system.factor(x, system.usable, world_held=True).joint(wanted)
        joint[:7] = joint[:, :7] = 0.0
        return joint
    active = active_of(system, tie)
    weights = system.as_weights(active)
    x = system.fit(replace(x, points=system.points_at(x, active)), weights, hold=True)
    return system.factor(x, weights).joint(wanted)


def _solve(system: System, frame: WorldFrame | None) -> tuple[Unknowns, Active, Factor] | str:
    """The answer, what it was solved from, and its system; or what is missing for one."""
    places = known_places(system)
    if frame is None or not len(places.names):
        return NOTHING
    if (missing := places.missing(system.params)) is not None:
        return missing
    world, near = places.robust_fit(system.params)
    if (missing := places[near].missing(system.params)) is not None:
        return f"{missing} (the others contradict them)" if not near.all() else missing
    x = system.terms.start(system.scenes, world)
    x = replace(x, points=_first_points(system, x))
    gross = places.gross(near, system.terms)
    x, active = _without_outliers(system, x, gross)
    factor = system.factor(x, system.as_weights(active))
    return _weak(system, factor) or (x, active, factor)


def _first_points(system: System, x: Unknowns) -> np.ndarray:
    met, _, told = system.terms.triangulated(x, np.ones(len(system.terms.images), dtype=bool))
    return np.where((told & system.is_check)[:, None], met, x.points)


def _without_outliers(system: System, x: Unknowns, gross: Active) -> tuple[Unknowns, Active]:
    """Graduated non-convexity (Geman-McClure) first; then data snooping: the worst out, what fits again in."""
    active: Active = tuple(use & ~bad for use, bad in zip(system.usable, gross, strict=True))  # type: ignore[assignment]
    x = system.fit(replace(x, points=system.points_at(x, active)), system.as_weights(active), max_steps=3)
    bars = [chi2.ppf(system.params.gate_probability, t.residuals.shape[1]) for t in system.terms.observations(x)]
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
    for _ in range(system.params.max_rounds):
        x = system.fit(replace(x, points=system.points_at(x, active)), system.as_weights(active))
        tests = system.tests(x, active, system.factor(x, system.as_weights(active)))
        if not _exchange(system, active, tests, failures):
            break
    return x, active


def _seen(system: System, x: Unknowns, active: Active, bars: Sequence[float]) -> list[tuple[Terms, np.ndarray, float]]:
    return list(zip(system.terms.observations(x), active, bars, strict=True))


def _exchange(system: System, active: Active, tests: Tests, failures: list[np.ndarray]) -> bool:
    """Leave out the observation that contradicts the others most, or take back one that does not; whether any."""
    worst, place = 0.0, None
    alpha = np.log(1 - system.params.gate_probability)
    for kind, (use, log_p) in enumerate(zip(active, tests.log_p, strict=True)):
        for k in np.flatnonzero(use & (log_p < alpha)).tolist():
            # Of two that say the same the survey of the point is doubted first: it is named first.
            if log_p[k] < worst - 1e-6 * abs(worst) - 1e-9 and not (kind == 1 and system.lone[k]):
                worst, place = float(log_p[k]), (kind, k)
    if place is not None:
        active[place[0]][place[1]] = False
        failures[place[0]][place[1]] += 1
        return True
    for kind, (use, log_p) in enumerate(zip(active, tests.log_p, strict=True)):
        back = system.usable[kind] & ~use & (log_p > alpha) & (failures[kind] < 2)
        if back.any():
            first = int(np.flatnonzero(back)[np.argmax(log_p[back])])
            use[first] = True
            failures[kind][first] += 1
            return True
    return False


def _weak(system: System, factor: Factor) -> str:
    """What the answer leaves open after all."""
    covariance = world_covariance(system, factor)
    values, axes = np.linalg.eigh(covariance[:3, :3])
    turn = float(np.degrees(np.sqrt(max(0.0, values[-1]))))
    if turn > system.params.max_rotation_sigma_deg:
        axis = ", ".join(f"{v:.2f}" for v in axes[:, -1])
        return (
            f"rotation about the map's axis ({axis}) is not determined (known to {turn:.2g} deg): add control "
            "points or positions far from the others, across that axis"
        )
    if np.sqrt(covariance[6, 6]) > system.params.max_log_scale_sigma:
        return (
            f"scale is not determined (known to {100 * np.sqrt(covariance[6, 6]):.2g} %): add control points or "
            "positions further apart, or a scale bar"
        )
    return ""

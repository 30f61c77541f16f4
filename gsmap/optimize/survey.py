"""Georeference a component: solve scene poses, ``S_world_map`` and control points from edges and observations together.

The datum of the map (its anchor scene, or priors) does not change, and ``S_world_map`` is free. So observations deform
the component within the uncertainty of its edges, but never move it as a whole. All unknowns are solved together by
Gauss-Newton on one sparse system, whose inverse gives covariances and tests every observation against the remaining
ones. See docs/design/0024-world-frame.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmap.errors import InputError
from gsmap.geometry.chi_square import chi2_quantile
from gsmap.geometry.similarities import Similarities
from gsmap.optimize.gtsam_solve import anchor_directions
from gsmap.optimize.measurements import all_rigid, measurements
from gsmap.optimize.priors import PriorTerms
from gsmap.optimize.survey_groups import SurveyFailure, solve_groups
from gsmap.optimize.survey_report import Solution, active_observations, build_world_tie, tie_by_bars
from gsmap.optimize.survey_system import Component, System
from gsmap.optimize.survey_terms import SurveyTerms
from gsmap.types import Edge, PoseGraph, Prior, Sim3
from gsmap.types.world import UNSOLVED, Georeference, Survey

_MAX_WIDENINGS = 4
_RARE = 0.05  # probability that a control point is a blunder, and that all are less precise than stated
_MAGNITUDES = 200.0  # range of the sizes of blunders, and of the standard deviations
_SURE = 7.0  # blunders must be so many times likelier to be left out
_LOW = 0.05  # probability that the points scatter even more than is assumed


@dataclass(frozen=True, eq=False)
class ComponentSolution:
    """Solution of a component with its observations of the world.

    Args:
        poses: poses of all scenes; scenes of other components keep the given poses.
        covariances: (n, 7, 7) covariances of the component's scenes, in the map's frame; None where observations change
            nothing.
        tie: georeference of the component.
    """

    poses: Similarities
    covariances: np.ndarray | None
    tie: Georeference


def tie_component(
    whole: Component, poses: Similarities, survey: Survey, index: int, marginal_scenes: int
) -> ComponentSolution | None:
    """Solve a component with its observations, from the poses computed by edges alone; None if it has no observations.

    Args:
        index: number of the component.
        marginal_scenes: covariances are computed for at most this many scenes.
    """
    own = whole.local()
    terms = SurveyTerms.of(survey, own.edges.scene_ids, own.dim)
    if not terms:
        return None
    system = System(own, terms, poses[whole.scenes])
    try:
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):  # infinite results are handled below
            surveyed = _surveyed(system, whole, poses, survey, index, marginal_scenes)
    # Raised by numpy, by scipy for a singular factor, and by Sim3.
    except (np.linalg.LinAlgError, RuntimeError, InputError):
        surveyed = None
    if surveyed is None or not _is_finite(surveyed):
        return ComponentSolution(poses, None, tie_by_bars(system, index, survey, SurveyFailure(UNSOLVED, "unsolved")))
    return surveyed


def _surveyed(
    system: System, whole: Component, poses: Similarities, survey: Survey, index: int, marginal_scenes: int
) -> ComponentSolution:
    system, found, scatter, note = _with_honest_points(system, survey)
    if isinstance(found, SurveyFailure):
        return ComponentSolution(poses, None, tie_by_bars(system, index, survey, found))
    x, factor = found.x, found.factor
    tie = build_world_tie(system, found, index, survey.frame)
    if note:
        tie = replace(tie, notes=(note, *tie.notes), point_scatter=scatter)
    covariances = factor.scene_covariances() if len(whole.scenes) <= marginal_scenes else None
    return ComponentSolution(poses.replaced(whole.scenes, x.scenes), covariances, tie)


def _with_honest_points(system: System, survey: Survey) -> tuple[System, Solution | SurveyFailure, float, str]:
    """Solve; where control points are left out that larger standard deviations of all explain about as well as
    blunders, solve again with these, because those that were left out may be right and the others wrong.

    Returns:
        The system with the standard deviations that were used, its solution, the factor by which these are larger than
        stated, and a note if they are.
    """
    found, times, note = solve_groups(system, survey.frame), 1.0, ""
    for _ in range(_MAX_WIDENINGS):
        if isinstance(found, SurveyFailure) or (scatter := _scatter(system, found)) == 1:
            break
        times *= scatter
        note = (
            f"control points scatter beyond their stated standard deviations, so these were taken to be {times:.2g} "
            "times as large (--sigma states them)"
        )
        terms = SurveyTerms.of(_widened(survey, times), system.terms.scene_ids, system.own.dim)
        system = System(system.own, terms, system.scenes)
        found = solve_groups(system, survey.frame)
    if note and isinstance(found, SurveyFailure):
        found = replace(found, problem=f"{note}; {found.problem}")
    return system, found, times, note


def _widened(survey: Survey, times: float) -> Survey:
    """Multiply the stated standard deviations of control points."""
    sigmas = {p.name: (times * p.sigma_m[0], times * p.sigma_m[1]) for p in survey.points}
    return replace(survey, points=tuple(replace(p, sigma_m=sigmas[p.name]) for p in survey.points))


def _scatter(system: System, found: Solution) -> float:
    """Return by how many times control points may scatter beyond their stated standard deviations, if that explains the
    points that are left out about as well as blunders do; else 1. It is an upper bound, since few points show it.

    Both hypotheses are compared by their likelihood. Blunders are rare, and of any order of magnitude; so are
    understated standard deviations, which are the same for all points.
    """
    tests = system.tests(found.x, found.active, found.factor)
    out = system.usable[0] & ~found.active[0] & (tests.dofs[0] == 3) & np.isfinite(tests.statistics[0])
    if not out.any() or not found.active[0].any():
        return 1.0
    used = system.terms.observations(found.x)[0].squares[found.active[0]].sum()
    squares = tests.statistics[0][out]
    total, dof = float(used + squares.sum()), float(tests.redundancies[0].sum() + 3 * out.sum())
    # Whitened residuals r of a blunder have the density 1 / (4 pi |r|^3 log(range)), times that of a normal at 0.
    blunder = 4 * np.pi * np.log(_MAGNITUDES) / (2 * np.pi) ** 1.5
    blunders = -used / 2 + (np.log(_RARE) - np.log(blunder * squares**1.5)).sum()
    variance = total / dof
    scattered = -dof / 2 * np.log(variance) - dof / 2 + np.log(_RARE * np.sqrt(np.pi / dof) / np.log(_MAGNITUDES))
    if variance <= 1 or blunders - scattered >= np.log(_SURE):
        return 1.0
    return float(np.sqrt(total / chi2_quantile(_LOW, int(dof))))


def _is_finite(surveyed: ComponentSolution) -> bool:
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
) -> np.ndarray | None:
    """Compute `gsmap.optimize.joint_covariance` by linearizing at the answer.

    Scene poses and ``S_world_map`` keep their values; only control points, uncertain cameras and common errors are
    solved.
    """
    ids = sorted(scene for scene, pose in answer.poses.items() if pose.component == component)
    inside = set(ids)
    mine = [e for e in edges if {e.target, e.source} <= inside and answer.use(e.target, e.source) != "unused"]
    here = [prior for prior in priors if prior.scene in inside]
    here = [prior for prior in here if prior.scene not in answer.provenance.contradicted_priors]
    m = measurements(ids, mine, rigid=all_rigid(mine, here, answer))
    poses = Similarities.stack([answer.poses[scene].S_map_scene for scene in ids])
    rows, terms = np.arange(len(ids)), PriorTerms.stack(ids, here)
    # The scene with the smallest covariance is the anchor.
    sure = [answer.poses[scene].covariance for scene in ids]
    anchor = int(np.argmin([np.inf if c is None else float(np.trace(c)) for c in sure]))
    held = anchor_directions(m, poses, rows, anchor, terms)
    tie = answer.tie(component)
    tied = tie is not None and tie.S_world_map is not None
    given = _widened(survey, tie.point_scatter) if tied and tie is not None else Survey()
    own = SurveyTerms.of(given, m.scene_ids, m.dim)
    system = System(Component(rows, m, terms, anchor, held), own, poses)
    x = own.start(poses, tie.S_world_map if tie is not None and tie.S_world_map is not None else Sim3.identity())
    row = {scene: k for k, scene in enumerate(ids)}
    wanted = [row[scene] for scene in scenes]
    if tie is None or not tied:
        joint = system.factor(x, system.usable, world_held=True).joint(wanted)
        joint[:7] = joint[:, :7] = 0.0
        return joint
    active = active_observations(system, tie)
    weights = system.as_weights(active)
    x = system.fit(replace(x, points=system.points_at(x, active)), weights, hold=True)
    joint = system.factor(x, weights).joint(wanted)
    root = np.ones(len(joint))
    root[:7] = np.sqrt(tie.variance_factor)  # as in the tie
    return joint * root * root[:, None]

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
from gsmap.geometry.similarities import Similarities
from gsmap.optimize.gtsam_solve import anchor_directions
from gsmap.optimize.measurements import all_rigid, measurements
from gsmap.optimize.priors import PriorTerms
from gsmap.optimize.survey_groups import SurveyFailure, solve_groups
from gsmap.optimize.survey_report import active_observations, build_world_tie, tie_by_bars
from gsmap.optimize.survey_system import Component, System
from gsmap.optimize.survey_terms import SurveyTerms
from gsmap.types import Edge, PoseGraph, Prior, Sim3
from gsmap.types.world import UNSOLVED, Georeference, Survey


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
    found = solve_groups(system, survey.frame)
    if isinstance(found, SurveyFailure):
        return ComponentSolution(poses, None, tie_by_bars(system, index, survey, found))
    x, factor = found.x, found.factor
    tie = build_world_tie(system, found, index, survey.frame)
    covariances = factor.scene_covariances() if len(whole.scenes) <= marginal_scenes else None
    return ComponentSolution(poses.replaced(whole.scenes, x.scenes), covariances, tie)


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
    own = SurveyTerms.of(survey if tied else Survey(), m.scene_ids, m.dim)
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
    return system.factor(x, weights).joint(wanted)

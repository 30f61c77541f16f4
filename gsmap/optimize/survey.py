"""A component tied to the world: scene poses, ``S_world_map`` and control points from edges and observations together.

The map's frame stays held as it was (by its anchor scene, or by priors), and ``S_world_map`` is free: so observations
bend the component where its edges leave room, and never move it as a whole. Everything is solved at once, by
Gauss-Newton on one sparse system, whose inverse then tests every observation against all others and gives covariances.
See docs/design/0024-world-frame.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmap.errors import InputError
from gsmap.geometry.similarities import Similarities
from gsmap.optimize.gtsam_solve import held_directions
from gsmap.optimize.measurements import all_rigid, measurements
from gsmap.optimize.priors import PriorTerms
from gsmap.optimize.survey_groups import Refusal, solve_groups
from gsmap.optimize.survey_report import active_of, lengths_only, report
from gsmap.optimize.survey_system import Component, System
from gsmap.optimize.survey_terms import SurveyTerms
from gsmap.types import Edge, PoseGraph, Prior, Sim3
from gsmap.types.world import UNSOLVED, Survey, WorldTie


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
    whole: Component, poses: Similarities, survey: Survey, index: int, marginal_scenes: int
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
    system = System(own, terms, poses[whole.scenes])
    try:
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):  # what is not finite is caught below
            surveyed = _surveyed(system, whole, poses, survey, index, marginal_scenes)
    except (np.linalg.LinAlgError, RuntimeError, InputError):  # of numpy, a singular factor in scipy, and Sim3
        surveyed = None
    if surveyed is None or not _is_finite(surveyed):
        return Surveyed(poses, None, lengths_only(system, index, survey, Refusal(UNSOLVED, "unsolved")))
    return surveyed


def _surveyed(
    system: System, whole: Component, poses: Similarities, survey: Survey, index: int, marginal_scenes: int
) -> Surveyed:
    found = solve_groups(system, survey.frame)
    if isinstance(found, Refusal):
        return Surveyed(poses, None, lengths_only(system, index, survey, found))
    x, factor = found.x, found.factor
    tie = report(system, found, index, survey.frame)
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
    held = held_directions(m, poses, rows, anchor, terms)
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
    active = active_of(system, tie)
    weights = system.as_weights(active)
    x = system.fit(replace(x, points=system.points_at(x, active)), weights, hold=True)
    return system.factor(x, weights).joint(wanted)

"""Robust pose-graph optimization: compute one pose per scene from pairwise edges, component by component.

`optimize` solves a map, and `grow` adds scenes to a solved map whose other measurements are unchanged. `diff` and
`moved` compare two answers, `gravity_align` turns an answer upright, and `keep_unchanged_poses` keeps unchanged poses.
Solvers (gtsam, networkx) load on first use.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmap.optimize.edge_likelihood import log_odds_wrong
from gsmap.optimize.gravity import gravity_align
from gsmap.optimize.measurements import check_priors
from gsmap.optimize.params import Params
from gsmap.optimize.pose_changes import diff, motion, moved
from gsmap.optimize.recipe import recipe_key
from gsmap.optimize.unchanged_poses import keep_unchanged_poses
from gsmap.types import Edge, PoseGraph, Prior
from gsmap.types.world import Survey

__all__ = [
    "Params",
    "check_priors",
    "diff",
    "gravity_align",
    "grow",
    "joint_covariance",
    "keep_unchanged_poses",
    "log_odds_wrong",
    "motion",
    "moved",
    "optimize",
    "recipe_key",
    "surroundings",
]


def optimize(
    scene_ids: Sequence[str],
    edges: Sequence[Edge],
    priors: Sequence[Prior] = (),
    previous: PoseGraph | None = None,
    params: Params | None = None,
    survey: Survey | None = None,
) -> PoseGraph:
    """Estimate the poses of all scenes from pairwise edges, some of which are wrong. Pure and deterministic.

    Recipe: triangles test the cycle consistency of every edge. Poses are initialized along the best supported edges;
    chordal relaxation and graduated non-convexity refine them. Edges that contradict the result are excluded, edges
    that agree with it are accepted. Components join where the evidence suffices, and are split where only places that
    look alike connect them. A Levenberg-Marquardt solve per component, with one gauge prior each, gives poses and
    marginal covariances.

    Args:
        scene_ids: all scenes of the map, oldest first. The oldest scene of a component defines the component's frame,
            and components of equal size are sorted by their oldest scene; nothing else depends on the order of scenes.
        edges: the measurements to consider, in any order; leave out edges that a person rejected.
        priors: pose priors. The anchor scene of a component fixes the freedom that its priors leave open.
        previous: the previous answer. The frame of its largest component is kept, so that maps do not jump. In large
            maps a few new scenes are placed in it (``provenance.method == "incremental"``); see `Params`.
        params: see `Params`.
        survey: observations of the world, with positions in the world frame. They deform the components that they
            georeference, but never move a component as a whole: its pose in the world is in ``world`` of the answer.

    Raises:
        InputError: an edge or prior is unusable, or confirmed edges contradict each other; the message names it.
    """
    from gsmap.optimize.batch import solve_batch
    from gsmap.optimize.incremental import place_new

    params = params or Params()
    # The order of sums and trials may decide close cases: order by content, not by arrival.
    edges = sorted(edges, key=lambda edge: (edge.target, edge.source))
    priors = sorted(priors, key=lambda prior: prior.scene)
    if previous is not None:
        placed = place_new(scene_ids, edges, priors, previous, params, survey or Survey())
        if placed is not None:
            return placed
    return solve_batch(scene_ids, edges, priors, previous, params, survey or Survey())


def surroundings(
    scene_ids: Sequence[str], pairs: Sequence[tuple[str, str]], previous: PoseGraph, params: Params
) -> tuple[set[str], set[str]]:
    """Return the scenes of the previous answer within reach of the new scenes, and the outermost ring of these scenes.

    Args:
        pairs: (target, source) of all edges that would be passed to `optimize`.
    """
    from gsmap.optimize.incremental import surroundings

    return surroundings(scene_ids, pairs, previous, params)


def grow(scene_ids: Sequence[str], edges: Sequence[Edge], previous: PoseGraph, params: Params) -> PoseGraph | None:
    """Place the new scenes in the previous answer; return None where only a full solve is correct.

    The caller guarantees that edges between old scenes, priors and observations have not changed.

    Args:
        edges: edges among the `surroundings`, by (target, source).
    """
    from gsmap.optimize.incremental import grow

    return grow(scene_ids, edges, previous, params)


def joint_covariance(
    answer: PoseGraph,
    edges: Sequence[Edge],
    priors: Sequence[Prior],
    survey: Survey | None,
    scenes: Sequence[str],
    component: int,
) -> np.ndarray | None:
    """Compute the joint covariance (7 + 7 S, 7 + 7 S) of ``S_world_map`` and the poses of S scenes of a component.

    Each block of 7 is over [rotation, translation, log scale] on the pose's source side; the block of the world is zero
    if the component is not georeferenced. Marginal covariances do not give the uncertainty between two scenes, because
    the errors of neighbouring scenes are correlated.

    Args:
        answer: an answer of `optimize`, with its edges, priors and observations.

    Returns:
        None if no edge reaches the scenes, or the system cannot be solved.
    """
    from gsmap.optimize.survey import joint_of_answer

    return joint_of_answer(answer, edges, priors, survey or Survey(), scenes, component)

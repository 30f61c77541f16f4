"""Edges in, one pose per scene out: robust, incremental, in as many components as the evidence ties together.

`optimize` is the entry, and `grow` that of who knows that only scenes came; `recipe_key` names its answers; `diff` and
`moved` compare two of them, `gravity_align` turns one upright, `kept_still` leaves alone what it did not change.
Solvers (gtsam, networkx) load on first use.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmap.optimize.changes import diff, motion, moved
from gsmap.optimize.gravity import gravity_align
from gsmap.optimize.likelihood import log_odds_wrong
from gsmap.optimize.measurements import check_priors
from gsmap.optimize.params import Params
from gsmap.optimize.recipe import recipe_key
from gsmap.optimize.stillness import kept_still
from gsmap.types import Edge, PoseGraph, Prior
from gsmap.types.progress import Progress, silent
from gsmap.types.world import Survey

__all__ = [
    "Params",
    "check_priors",
    "diff",
    "gravity_align",
    "grow",
    "joint_covariance",
    "kept_still",
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
    progress: Progress = silent,
    survey: Survey | None = None,
) -> PoseGraph:
    """Poses of all scenes from pairwise edges, some of which are wrong. Pure and deterministic.

    Recipe: every edge is voted on by the triangles through it; poses start along the best supported edges; a chordal
    relaxation and graduated non-convexity refine them; edges that contradict the result are let go and those that agree
    with it taken in; components join where the evidence suffices, and part where places that look alike tied them; a
    Levenberg-Marquardt solve per component, with one gauge prior each, gives poses and marginal covariances.

    Args:
        scene_ids: all scenes of the map, oldest first. The oldest scene of a component holds its frame, and of
            components of one size that of the oldest scene comes first; nothing else depends on their order.
        edges: the measurements to consider, in any order; leave out what a person rejected.
        priors: outside knowledge. A component whose priors leave a freedom open is held there by its anchor scene.
        previous: the last answer. Its largest component's frame survives, so that maps do not jump. In large maps, if
            only few scenes are new, they are placed in it (``provenance.method == "incremental"``); see `Params`.
        params: see `Params`.
        progress: called with a fraction and a short text.
        survey: observations of the world, positions in the world frame. They bend the components that they tie to the
            world, and never move one as a whole: where it lies is in ``world`` of the answer.

    Raises:
        InputError: an edge or prior is unusable, or confirmed edges contradict each other; the message names it.
    """
    from gsmap.optimize.batch import solve_batch
    from gsmap.optimize.incremental import place_new

    params = params or Params()
    # What is summed, numbered or tried first may decide what is close: by content, not by who came first.
    edges = sorted(edges, key=lambda edge: (edge.target, edge.source))
    priors = sorted(priors, key=lambda prior: prior.scene)
    if previous is not None:
        placed = place_new(scene_ids, edges, priors, previous, params, survey or Survey())
        if placed is not None:
            return placed
    return solve_batch(scene_ids, edges, priors, previous, params, progress, survey or Survey())


def surroundings(
    scene_ids: Sequence[str], pairs: Sequence[tuple[str, str]], previous: PoseGraph, params: Params
) -> tuple[set[str], set[str]]:
    """The scenes that placing the new ones in the last answer looks at, and the outermost of them, in which nothing may
    move without a look further; none where everything is solved anew.

    Args:
        pairs: (target, source) of all edges that `optimize` would be given.
    """
    from gsmap.optimize.incremental import surroundings

    return surroundings(scene_ids, pairs, previous, params)


def grow(scene_ids: Sequence[str], edges: Sequence[Edge], previous: PoseGraph, params: Params) -> PoseGraph | None:
    """What `optimize` answers where it can place the new scenes in the last answer; None where it cannot.

    For who knows that nothing else has changed: edges between old scenes, priors, observations.

    Args:
        edges: those among the `surroundings`, by (target, source).
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
    """(7 + 7 S, 7 + 7 S) covariance of ``S_world_map`` and the poses of some scenes of a component, together.

    Each over [rotation, translation, log scale] on its source side; zero for the world where the component is not tied.
    Marginals do not tell how well two scenes are known to each other: next to each other they err alike.

    Args:
        answer: as `optimize` gave it, with the edges, priors and observations that it rests on.

    Returns:
        None where the scenes are alone, or the system cannot be solved.
    """
    from gsmap.optimize.survey import joint_of_answer

    return joint_of_answer(answer, edges, priors, survey or Survey(), scenes, component)

"""Final solve: compute the poses and covariances of each component in its own frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsmap.geometry.similarities import Similarities
from gsmap.optimize.gauge import choose_anchor, free_gauge_directions, move_onto_anchor, move_onto_priors
from gsmap.optimize.gtsam_solve import anchor_directions, solve
from gsmap.optimize.measurements import Measurements
from gsmap.optimize.params import Params
from gsmap.optimize.state import State
from gsmap.optimize.structure import component_labels
from gsmap.optimize.survey import tie_component
from gsmap.optimize.survey_system import Component
from gsmap.types import PoseGraph, Sim3
from gsmap.types.world import Georeference, Survey


@dataclass(frozen=True, eq=False)
class FinalPoses:
    """Final poses of all scenes.

    Args:
        poses: N poses.
        component: (N,) number of each scene's component, the largest first. All components that priors fix completely
            share the frame of the priors and one number.
        covariances: (N, 7, 7), zero where not computed.
        notes: messages about missing covariances.
        world: georeferences of the components with observations.
    """

    poses: Similarities
    component: np.ndarray
    covariances: np.ndarray
    notes: tuple[str, ...]
    world: tuple[Georeference, ...] = ()


def solve_components(
    m: Measurements,
    state: State,
    ages: np.ndarray,
    previous: PoseGraph | None,
    params: Params,
    survey: Survey,
) -> FinalPoses:
    """Compute exact poses and covariances of every component from the accepted edges.

    Args:
        ages: (N,) rank of each scene, oldest first: the oldest scene of a component is its anchor.
    """
    rows = np.flatnonzero(state.accepted)
    labels = component_labels(m, rows)
    sizes = np.bincount(labels, minlength=1)
    members = np.split(np.lexsort((ages, labels)), np.cumsum(sizes)[:-1]) if m.num_scenes else []
    order = sorted(range(labels.max(initial=-1) + 1), key=lambda k: (-sizes[k], ages[members[k][0]]))
    edge_order = rows[np.argsort(labels[m.targets[rows]], kind="stable")]
    edge_members = np.split(edge_order, np.cumsum(np.bincount(labels[m.targets[rows]], minlength=len(sizes)))[:-1])
    prior_labels = labels[state.terms.scenes]
    with_priors = set(prior_labels.tolist())

    poses = state.poses
    covariances = np.zeros((m.num_scenes, 7, 7))
    component = np.zeros(m.num_scenes, dtype=np.int64)
    missing: list[tuple[int, int, str]] = []
    ties: list[tuple[int, Georeference]] = []
    world: int | None = None
    max_scenes = params.max_marginal_scenes if params.marginals else 0
    for index, label in enumerate(order):
        scenes, mine = members[label], edge_members[label]
        own = state.terms[np.flatnonzero(prior_labels == label)] if label in with_priors else state.terms[:0]
        anchor = choose_anchor(scenes, m.scene_ids, previous)
        component[scenes] = index
        old = previous.poses.get(m.scene_ids[anchor]) if previous else None
        poses = move_onto_anchor(poses, scenes, anchor, old.S_map_scene if old else Sim3.identity())
        if len(own):
            poses = move_onto_priors(poses, scenes, anchor, own, m.dim)
            if not len(free_gauge_directions(poses, scenes, anchor, own, m.dim)):
                # The priors fix the component completely: it shares the frame of the priors with all such components.
                component[scenes] = world = index if world is None else world
        if len(mine) or len(own):
            solution = solve(m[mine], poses, anchor, own, max_scenes)
            poses = solution.poses
            if solution.covariances is not None:
                covariances[scenes] = solution.covariances[scenes]
            elif params.marginals:
                reason = solution.problem or f"optimize.max_marginal_scenes is {max_scenes}"
                missing.append((int(scenes[0]), len(scenes), reason))
        if survey:
            held = anchor_directions(m[mine], poses, scenes, anchor, own)
            whole = Component(scenes, m[mine], own, anchor, held)
            surveyed = tie_component(whole, poses, survey, index, max_scenes)
            if surveyed is not None:
                poses = surveyed.poses
                ties.append((int(scenes[0]), surveyed.tie))
                if surveyed.covariances is not None and (len(mine) or len(own)):
                    covariances[scenes] = surveyed.covariances
    _, component = np.unique(component, return_inverse=True)
    notes = tuple(
        f"no covariances in component {component[scene]} ({size} scenes): {reason}" for scene, size, reason in missing
    )
    placed: dict[int, Georeference] = {}
    for scene, tie in ties:  # if components share the frame of the priors, the largest gives the georeference
        placed.setdefault(int(component[scene]), replace(tie, component=int(component[scene])))
    return FinalPoses(poses, component, covariances, notes, tuple(placed.values()))

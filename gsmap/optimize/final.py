"""The last solve: each component by itself, in its own frame, with the covariances of its scenes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsmap.geometry.similarities import Similarities
from gsmap.optimize.gauge import anchor_of, onto_anchor, onto_priors, open_gauge
from gsmap.optimize.gtsam_solve import held_directions, solve
from gsmap.optimize.measurements import Measurements
from gsmap.optimize.params import Params
from gsmap.optimize.state import State
from gsmap.optimize.structure import component_labels
from gsmap.optimize.survey import tie_component
from gsmap.optimize.survey_system import Component
from gsmap.types import PoseGraph, Sim3
from gsmap.types.progress import Progress
from gsmap.types.world import Survey, WorldTie


@dataclass(frozen=True, eq=False)
class Solved:
    """All scenes in their final frames.

    Args:
        poses: N.
        component: (N,) largest first; those that priors fix completely share the outside world's frame, as one.
        covariances: (N, 7, 7), zero where there is none.
        notes: on covariances that there are not.
        world: where components lie in the world, of those of which anything was observed.
    """

    poses: Similarities
    component: np.ndarray
    covariances: np.ndarray
    notes: tuple[str, ...]
    world: tuple[WorldTie, ...] = ()


def solve_components(
    m: Measurements,
    state: State,
    ages: np.ndarray,
    previous: PoseGraph | None,
    params: Params,
    progress: Progress,
    survey: Survey,
) -> Solved:
    """Exact poses and covariances of every component from the edges that are taken in.

    Args:
        ages: (N,) the place of each scene among all, oldest first: the oldest of a component holds its frame.
    """
    rows = np.flatnonzero(state.accepted)
    labels = component_labels(m, rows)
    sizes = np.bincount(labels, minlength=1)
    members = np.split(np.lexsort((ages, labels)), np.cumsum(sizes)[:-1]) if m.num_scenes else []
    order = sorted(range(labels.max(initial=-1) + 1), key=lambda k: (-sizes[k], ages[members[k][0]]))
    edge_order = rows[np.argsort(labels[m.targets[rows]], kind="stable")]
    edge_members = np.split(edge_order, np.cumsum(np.bincount(labels[m.targets[rows]], minlength=len(sizes)))[:-1])
    prior_labels = labels[state.terms.scenes]
    tied = set(prior_labels.tolist())

    poses = state.poses
    covariances = np.zeros((m.num_scenes, 7, 7))
    component = np.zeros(m.num_scenes, dtype=np.int64)
    missing: list[tuple[int, int, str]] = []
    ties: list[tuple[int, WorldTie]] = []
    world: int | None = None
    most = params.max_marginal_scenes if params.marginals else 0
    for index, label in enumerate(order):
        progress(index / len(order), "final solve")
        scenes, mine = members[label], edge_members[label]
        own = state.terms[np.flatnonzero(prior_labels == label)] if label in tied else state.terms[:0]
        anchor = anchor_of(scenes, m.scene_ids, previous)
        component[scenes] = index
        old = previous.poses.get(m.scene_ids[anchor]) if previous else None
        poses = onto_anchor(poses, scenes, anchor, old.S_map_scene if old else Sim3.identity())
        if len(own):
            poses = onto_priors(poses, scenes, anchor, own, m.dim)
            if not len(open_gauge(poses, scenes, anchor, own, m.dim)):
                # Fully known to the outside: it shares the world's frame with every other such component.
                component[scenes] = world = index if world is None else world
        if len(mine) or len(own):
            solution = solve(m[mine], poses, anchor, own, most)
            poses = solution.poses
            if solution.covariances is not None:
                covariances[scenes] = solution.covariances[scenes]
            elif params.marginals:
                why = solution.problem or f"more than max_marginal_scenes, {most}"
                missing.append((int(scenes[0]), len(scenes), why))
        if survey:
            held = held_directions(m[mine], poses, scenes, anchor, own)
            whole = Component(scenes, m[mine], own, anchor, held)
            surveyed = tie_component(whole, poses, survey, index, most)
            if surveyed is not None:
                poses = surveyed.poses
                ties.append((int(scenes[0]), surveyed.tie))
                if surveyed.covariances is not None and (len(mine) or len(own)):
                    covariances[scenes] = surveyed.covariances
    _, component = np.unique(component, return_inverse=True)
    notes = tuple(
        f"no covariances in component {component[scene]} ({size} scenes): {why}" for scene, size, why in missing
    )
    placed: dict[int, WorldTie] = {}
    for scene, tie in ties:  # of components that priors put into one frame, the largest says where that is
        placed.setdefault(int(component[scene]), replace(tie, component=int(component[scene])))
    return Solved(poses, component, covariances, notes, tuple(placed.values()))

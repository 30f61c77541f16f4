"""Compute the metric scale of each component of a map from its catalog."""

from __future__ import annotations

import math
from collections.abc import Mapping

from gsmap.errors import NotFoundError
from gsmap.geometry.metric_scale import PLAUSIBLE_M, SceneUnit, estimate_metric_scale
from gsmap.store import Store
from gsmap.types import PoseGraph, ScenePose
from gsmap.types.metric_scale import MetricScale
from gsmap.types.world import Georeference


def metres_at(store: Store, revision: int | None = None) -> dict[int, MetricScale]:
    """Return the metric scale of every component of a revision, by default the newest."""
    graph = (
        PoseGraph(store.revisions.poses(), world=store.revisions.world())
        if revision is None
        else store.revisions.get(revision)
    )
    return map_metres(store, graph)


def map_metres(store: Store, graph: PoseGraph | None) -> dict[int, MetricScale]:
    """Return the metric scale of every component, the largest component first, without reading arrays.

    Scenes removed since count as long as the poses are those that they took part in.
    """
    told, policies = (
        store.scenes.specified_metres(),
        {scene.id: scene.scale_policy for scene in store.scenes.summaries()},
    )
    guesses = {graph.scene: graph.unit_m for graph in store.graphs.list()}  # oldest first: the newest stays
    components: dict[int, list[tuple[SceneUnit, ScenePose]]] = {}
    low, high = PLAUSIBLE_M
    for pose in graph.poses.values() if graph else ():
        policy, guess = policies.get(pose.scene), guesses.get(pose.scene)
        if policy is None:
            try:
                policy = store.scenes.get(pose.scene).scale_policy
            except NotFoundError:
                continue  # forgotten, and all that was said of it
        if guess is not None and not (math.isfinite(guess) and guess > 0):
            guess = None
        unit = SceneUnit(
            specified=told.get(pose.scene),
            in_metres=policy == "known",
            # As registration takes it (`gsmap.describe.unit.landmark_units`): metres, where that is plausible.
            may_be_metres=policy == "auto" and guess is not None and low < guess < high,
            guess_m=None if policy == "known" else guess,
        )
        components.setdefault(pose.component, []).append((unit, pose))
    ties = {tie.component: tie for tie in (graph.world if graph else ()) if tie.metres_per_unit is not None}
    return {
        component: estimate_metric_scale(components[component], _surveyed(ties.get(component)))
        for component in sorted(components)
    }


def _surveyed(tie: Georeference | None) -> tuple[float, float] | None:
    return None if tie is None or tie.metres_per_unit is None else (tie.metres_per_unit, tie.scale_sigma)


def metres_of_scenes(store: Store, graph: PoseGraph) -> dict[str, float]:
    """Return metres per unit of the frame of each scene's component, by scene id."""
    metres = map_metres(store, graph)
    return {
        scene: metres[pose.component].metres_per_unit if pose.component in metres else 1.0
        for scene, pose in graph.poses.items()
    }


def metre_notes(metres: Mapping[int, MetricScale]) -> tuple[str, ...]:
    """Return the notes on metric scales, each note once with its components."""
    components: dict[str, list[int]] = {}
    for component, metre in metres.items():
        if metre.note:
            components.setdefault(metre.note, []).append(component)
    return tuple(
        f"component{'s' * (len(of) > 1)} {', '.join(map(str, of[:5]))}{' and more' * (len(of) > 5)}: {note}"
        for note, of in components.items()
    )

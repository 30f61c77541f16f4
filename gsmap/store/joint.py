"""One pose graph of two maps' newest: the other's scenes beside our own, in our frame where shared scenes tell it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np

from gsmap.geometry.boxes import box_corners
from gsmap.geometry.chi_square import chi2_quantile
from gsmap.geometry.similarities import Similarities
from gsmap.geometry.umeyama import umeyama
from gsmap.types import PoseGraph, ScenePose, Sim3
from gsmap.types.world import Georeference

# Scenes in both maps agree where their poses differ by no more than what both solutions leave open. The covariance of
# the scene that holds a component's frame is next to nothing, so that this much is always allowed: [rad, scene units,
# log scale].
_FLOOR = np.array([2e-3] * 3 + [0.02] * 3 + [2e-3])
_QUANTILE = 0.999


def joined(ours: PoseGraph, theirs: PoseGraph, living: Collection[str], bounds: Mapping[str, np.ndarray]) -> PoseGraph:
    """Our poses as they are, and theirs of the scenes that only they have placed.

    A component of theirs that shares scenes with one of ours is moved into its frame by one similarity if all shared
    scenes then agree; else it stays a component of its own, and a note says so. Nothing is solved.

    Args:
        living: scenes that the answer may hold.
        bounds: (2, 3) box of each scene in its own frame, by id.
    """
    poses = {scene: pose for scene, pose in ours.poses.items() if scene in living}
    notes: list[str] = []
    components = [[p for p in theirs.poses.values() if p.component == k] for k in _components(theirs)]
    free = max((pose.component for pose in poses.values()), default=-1) + 1
    for members in components:
        new = [pose for pose in members if pose.scene in living and pose.scene not in poses]
        if not new:
            continue
        shared = [pose for pose in members if pose.scene in ours.poses and pose.scene in bounds]
        component, S_ours_theirs = free, Sim3.identity()
        if shared:
            component = Counter(ours.poses[pose.scene].component for pose in shared).most_common(1)[0][0]
            common = [(ours.poses[p.scene], p) for p in shared if ours.poses[p.scene].component == component]
            S_ours_theirs = _between(common, bounds)
            if not _agree(common, S_ours_theirs):
                notes.append(f"{len(new)} scenes stay a component of their own: those in both maps lie otherwise here")
                component, S_ours_theirs = free, Sim3.identity()
        for pose in new:
            moved = S_ours_theirs @ pose.S_map_scene
            poses[pose.scene] = replace(pose, S_map_scene=moved, component=component)
        free = max(free, component + 1)
    outcomes = {pair: outcome for pair, outcome in ours.outcomes.items() if set(pair) <= set(poses)}
    known = {frozenset(pair) for pair in outcomes}
    outcomes |= {
        pair: outcome
        for pair, outcome in theirs.outcomes.items()
        if set(pair) <= set(poses) and frozenset(pair) not in known
    }
    placed = _largest_first(poses)
    world = _ties(ours, placed, {scene: pose.component for scene, pose in ours.poses.items()})
    known_in_world = {tie.component for tie in world}
    apart = {pose.scene: pose.component for pose in theirs.poses.values() if pose.scene not in ours.poses}
    # A component of theirs that came into a frame of ours left its own, and its tie with it.
    left = {pose.component for pose in theirs.poses.values() if pose.scene in ours.poses}
    world += tuple(
        tie
        for tie in _ties(theirs, placed, {s: c for s, c in apart.items() if c not in left})
        if tie.component not in known_in_world
    )
    return PoseGraph(placed, outcomes, settings=ours.settings, notes=tuple(notes), world=world)


def restricted(graph: PoseGraph, scenes: Collection[str]) -> PoseGraph:
    """The poses of some scenes, and what became of the edges among them."""
    poses = {scene: pose for scene, pose in graph.poses.items() if scene in scenes}
    outcomes = {pair: outcome for pair, outcome in graph.outcomes.items() if set(pair) <= set(poses)}
    placed = _largest_first(poses)
    world = _ties(graph, placed, {scene: pose.component for scene, pose in poses.items()})
    return PoseGraph(placed, outcomes, settings=graph.settings, notes=graph.notes, world=world)


def _ties(graph: PoseGraph, placed: Mapping[str, ScenePose], before: Mapping[str, int]) -> tuple[Georeference, ...]:
    """Where components lie in the world, under their new numbers; of what was observed, that of scenes that are here.

    Args:
        before: component of scenes in ``graph``, of those whose frame is what it was.
    """
    now = {component: placed[scene].component for scene, component in before.items() if scene in placed}
    return tuple(
        replace(
            tie,
            component=now[tie.component],
            residuals=tuple(row for row in tie.residuals if not row.scene or row.scene in placed),
        )
        for tie in graph.world
        if tie.component in now
    )


def _components(graph: PoseGraph) -> list[int]:
    return sorted({pose.component for pose in graph.poses.values()})


def _between(common: list[tuple[ScenePose, ScenePose]], bounds: Mapping[str, np.ndarray]) -> Sim3:
    """``S_ours_theirs`` from where both put the corners of the scenes they share; exact for one scene."""
    if len(common) == 1:
        mine, other = common[0]
        return mine.S_map_scene @ other.S_map_scene.inverse()
    corners = [box_corners(bounds[mine.scene]) for mine, _ in common]
    here = np.concatenate([mine.S_map_scene.apply(points) for (mine, _), points in zip(common, corners, strict=True)])
    there = np.concatenate(
        [other.S_map_scene.apply(points) for (_, other), points in zip(common, corners, strict=True)]
    )
    rigid = all(pose.S_map_scene.is_rigid for pair in common for pose in pair)
    return umeyama(here, there, with_scale=not rigid)


def _agree(common: list[tuple[ScenePose, ScenePose]], S_ours_theirs: Sim3) -> bool:
    off = [mine.S_map_scene.inverse() @ S_ours_theirs @ other.S_map_scene for mine, other in common]
    bar = float(chi2_quantile(_QUANTILE, 7))
    for (mine, other), xi in zip(common, Similarities.stack(off).log(), strict=True):
        covariance = np.diag(_FLOOR**2)
        for pose in (mine, other):
            if pose.covariance is not None and np.isfinite(pose.covariance).all():
                covariance = covariance + pose.covariance
        if xi @ np.linalg.solve(covariance, xi) > bar:
            return False
    return True


def _largest_first(poses: Mapping[str, ScenePose]) -> dict[str, ScenePose]:
    """Components numbered anew, the largest first; of equal ones the one that was first."""
    sizes = Counter(pose.component for pose in poses.values())
    order = {component: i for i, component in enumerate(sorted(sizes, key=lambda k: (-sizes[k], k)))}
    return {scene: replace(pose, component=order[pose.component]) for scene, pose in poses.items()}

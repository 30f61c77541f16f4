"""Join the newest pose graphs of two maps, which shared scenes align."""

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

# Shared scenes agree if their poses differ by no more than the covariances of both solutions allow. The covariance of
# the anchor of a component is almost zero, so that these sigmas are always allowed: [rad, scene units, log scale].
_MIN_SIGMAS = np.array([2e-3] * 3 + [0.02] * 3 + [2e-3])
_QUANTILE = 0.999


def join_pose_graphs(
    ours: PoseGraph, theirs: PoseGraph, living: Collection[str], bounds: Mapping[str, np.ndarray]
) -> PoseGraph:
    """Add to our pose graph the poses of scenes that only their pose graph places, without optimizing.

    A component of theirs that shares scenes with one of ours is moved to our frame by one similarity if all shared
    scenes then agree; otherwise it stays a separate component, with a note.

    Args:
        living: scenes that the result may contain.
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
                notes.append(
                    f"{len(new)} scenes stay a separate component: the scenes that both maps share have "
                    "different poses here"
                )
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
    # A component of theirs that was moved to a frame of ours loses its world tie.
    left = {pose.component for pose in theirs.poses.values() if pose.scene in ours.poses}
    world += tuple(
        tie
        for tie in _ties(theirs, placed, {s: c for s, c in apart.items() if c not in left})
        if tie.component not in known_in_world
    )
    return PoseGraph(placed, outcomes, settings=ours.settings, notes=tuple(notes), world=world)


def restrict_pose_graph(graph: PoseGraph, scenes: Collection[str]) -> PoseGraph:
    """Restrict a pose graph to some scenes and the edges between these scenes."""
    poses = {scene: pose for scene, pose in graph.poses.items() if scene in scenes}
    outcomes = {pair: outcome for pair, outcome in graph.outcomes.items() if set(pair) <= set(poses)}
    placed = _largest_first(poses)
    world = _ties(graph, placed, {scene: pose.component for scene, pose in poses.items()})
    return PoseGraph(placed, outcomes, settings=graph.settings, notes=graph.notes, world=world)


def _ties(graph: PoseGraph, placed: Mapping[str, ScenePose], before: Mapping[str, int]) -> tuple[Georeference, ...]:
    """Return the georeferences of components under their new numbers, with the residuals of scenes that are present.

    Args:
        before: component of each scene of ``graph`` whose component keeps its frame.
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
    """Estimate ``S_ours_theirs`` by Umeyama's method from the box corners of shared scenes; exact for one scene."""
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
        covariance = np.diag(_MIN_SIGMAS**2)
        for pose in (mine, other):
            if pose.covariance is not None and np.isfinite(pose.covariance).all():
                covariance = covariance + pose.covariance
        if xi @ np.linalg.solve(covariance, xi) > bar:
            return False
    return True


def _largest_first(poses: Mapping[str, ScenePose]) -> dict[str, ScenePose]:
    """Renumber components, the largest first; equally large components keep their order."""
    sizes = Counter(pose.component for pose in poses.values())
    order = {component: i for i, component in enumerate(sorted(sizes, key=lambda k: (-sizes[k], k)))}
    return {scene: replace(pose, component=order[pose.component]) for scene, pose in poses.items()}

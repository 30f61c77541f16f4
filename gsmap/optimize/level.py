"""Turning islands upright: the map's z against gravity, where scenes know what is up."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np

from gsmap.types import PoseGraph, ScenePose, Sim3

_LEVEL_RAD = np.radians(5.0)


def leveled(graph: PoseGraph, ups: Mapping[str, np.ndarray], fixed: Collection[str] = ()) -> PoseGraph:
    """The same answer with every island turned as a whole so that up is +z, unless it is within 5 degrees already.

    Poses relative to each other, and covariances (which are on the scenes' side), do not change.

    Args:
        ups: (3,) direction against gravity in the scene's frame, by scene id; scenes that cannot tell are left out.
        fixed: scenes held by a prior; their islands stay as they are.
    """
    islands: dict[int, list[ScenePose]] = {}
    for pose in graph.poses.values():
        islands.setdefault(pose.component, []).append(pose)
    poses = dict(graph.poses)
    for members in islands.values():
        votes = [p.S_map_scene.rotation @ ups[p.scene] for p in members if p.scene in ups]
        if not votes or any(p.scene in fixed for p in members):
            continue
        up = np.median(votes, axis=0)  # one scene that took a wall for the floor must not tilt the map
        if np.linalg.norm(up) < 0.5 or np.arccos(np.clip(up[2] / np.linalg.norm(up), -1, 1)) < _LEVEL_RAD:
            continue
        turn = Sim3(_rotation_to_z(up / np.linalg.norm(up)), np.zeros(3))
        for pose in members:
            poses[pose.scene] = replace(pose, S_map_scene=turn @ pose.S_map_scene)
    return replace(graph, poses=poses)


def _rotation_to_z(up: np.ndarray) -> np.ndarray:
    """The shortest rotation (3, 3) that takes a unit vector to +z."""
    x, y, z = up
    if z < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    k = np.array([[0, 0, -x], [0, 0, -y], [x, y, 0]])
    return np.eye(3) + k + k @ k / (1 + z)

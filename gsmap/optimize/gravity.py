"""Turn components upright: align z of the map with the vertical of its scenes."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np

from gsmap.geometry.directions import rotation_to_z
from gsmap.geometry.similarities import Similarities
from gsmap.optimize.params import Params
from gsmap.types import PoseGraph, ScenePose, Sim3
from gsmap.types.world import Georeference

_MIN_AGREEMENT = 0.5  # if the median of the unit up directions is shorter, the scenes disagree


def gravity_align(
    graph: PoseGraph, ups: Mapping[str, np.ndarray], fixed: Collection[str] = (), params: Params | None = None
) -> PoseGraph:
    """Rotate every component as a whole so that up is +z, unless the component is nearly upright already.

    Relative poses do not change, nor do covariances, which are on the scenes' side.

    Args:
        ups: (3,) direction against gravity in the scene's frame, by scene id, where known.
        fixed: scenes with a pose prior; their components stay as they are.
        params: ``max_tilt_deg`` is used.
    """
    params = params or Params()
    components: dict[int, list[ScenePose]] = {}
    for pose in graph.poses.values():
        components.setdefault(pose.component, []).append(pose)
    poses = dict(graph.poses)
    world = {tie.component: tie for tie in graph.world}
    for component, members in components.items():
        ups_in_map = [p.S_map_scene.rotation @ ups[p.scene] for p in members if p.scene in ups]
        if not ups_in_map or any(p.scene in fixed for p in members):
            continue
        up = np.median(ups_in_map, axis=0)  # robust to a scene that mistook a wall for the floor
        length = np.linalg.norm(up)
        if length < _MIN_AGREEMENT:
            continue
        if np.arccos(np.clip(up[2] / length, -1, 1)) < np.radians(params.max_tilt_deg):
            continue
        turn = Sim3(rotation_to_z(up / length), np.zeros(3))
        for pose in members:
            poses[pose.scene] = replace(pose, S_map_scene=turn @ pose.S_map_scene)
        if component in world:
            world[component] = _turned(world[component], turn)
    return replace(graph, poses=poses, world=tuple(world.values()))


def _turned(tie: Georeference, turn: Sim3) -> Georeference:
    """Return the georeference of a component whose frame was rotated."""
    if tie.S_world_map is None or tie.covariance is None:
        return tie
    to_new = Similarities.stack([turn]).adjoint()[0]
    covariance = to_new @ tie.covariance @ to_new.T
    return replace(tie, S_world_map=tie.S_world_map @ turn.inverse(), covariance=(covariance + covariance.T) / 2)

"""Islands are turned upright as a whole."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsmap import PoseGraph, ScenePose, Sim3
from gsmap.optimize import gravity_align

RNG = np.random.default_rng(11)


def island(component: int, count: int, turn: np.ndarray) -> tuple[dict, dict]:
    poses, ups = {}, {}
    for i in range(count):
        name = f"{component}-{i}"
        pose = Sim3(turn @ Rotation.random(rng=RNG).as_matrix(), RNG.normal(size=3))
        poses[name] = ScenePose(name, pose, component, "placed")
        ups[name] = pose.rotation.T @ turn @ [0, 0, 1.0]
    return poses, ups


@pytest.mark.parametrize("turn", [Rotation.from_euler("x", 80, degrees=True).as_matrix(), np.diag([1.0, -1, -1])])
def test_up_becomes_z_and_relative_poses_stay(turn: np.ndarray) -> None:
    poses, ups = island(0, 4, turn)
    ups["0-0"] = Rotation.from_euler("x", 90, degrees=True).as_matrix() @ ups["0-0"]  # one scene errs
    out = gravity_align(PoseGraph(poses), ups).poses
    for name in ("0-1", "0-2", "0-3"):
        np.testing.assert_allclose(out[name].S_map_scene.rotation @ ups[name], [0, 0, 1], atol=1e-9)
    before = poses["0-1"].S_map_scene.inverse() @ poses["0-2"].S_map_scene
    after = out["0-1"].S_map_scene.inverse() @ out["0-2"].S_map_scene
    np.testing.assert_allclose(after.matrix(), before.matrix(), atol=1e-12)


def test_nearly_level_and_held_islands_stay() -> None:
    nearly, ups = island(0, 3, Rotation.from_euler("x", 3, degrees=True).as_matrix())
    held, more = island(1, 3, Rotation.from_euler("x", 50, degrees=True).as_matrix())
    graph = PoseGraph({**nearly, **held})
    out = gravity_align(graph, {**ups, **more}, fixed={"1-2"})
    assert out.poses == graph.poses

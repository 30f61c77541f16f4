"""What several scenes say of a scan is one answer, or none."""

from __future__ import annotations

import numpy as np
import pytest

from gsmap.geometry.rotations import exp_so3
from gsmap.geometry.similarities import exp
from gsmap.localize.scan_consensus import PoseTolerance, ScanPose, combine_poses
from gsmap.types import Registration, ScenePose, Sim3

ONE = PoseTolerance(rotation_deg=3.0, distance=0.3, log_scale=0.02, sigmas=5.0)
NAMES = {"a": "hall", "b": "kitchen", "c": "attic"}
MIDDLE = np.array([1.0, 2.0, 0.5])
POSE = Sim3(exp_so3(np.array([0.3, -0.2, 1.0])), np.array([4.0, 1.0, 0.0]))
SIGMAS = np.array([0.002, 0.002, 0.002, 0.01, 0.01, 0.01, 0.005])


def moved(xi: list[float]) -> Sim3:
    return POSE @ exp(np.array([xi])).item(0)


def support(scene: str, xi: list[float], probability: float = 0.95, component: int = 0) -> ScanPose:
    return ScanPose(scene, component, moved(xi), np.diag(SIGMAS**2), probability)


def test_one_supporter_is_itself() -> None:
    found = combine_poses([support("a", [0] * 7)], MIDDLE, ONE, NAMES)
    assert found.S_map_scan is not None
    np.testing.assert_allclose(found.S_map_scan.matrix(), POSE.matrix(), atol=1e-9)
    np.testing.assert_allclose(found.covariance, np.diag(SIGMAS**2), atol=1e-12)
    assert found.probability == 0.95


def test_agreeing_ones_are_averaged_and_not_believed_to_be_independent() -> None:
    off = [0, 0, 0.001, 0.004, 0, 0, 0]
    found = combine_poses([support("a", off), support("b", [-v for v in off], 0.99)], MIDDLE, ONE, NAMES)
    assert found.S_map_scan is not None
    assert found.covariance is not None
    np.testing.assert_allclose(found.S_map_scan.matrix(), POSE.matrix(), atol=1e-5)
    assert found.S_map_scan.scale == 1.0
    assert (np.diag(found.covariance) >= 0.99 * SIGMAS**2).all()
    assert found.probability == 0.99


def test_scatter_beyond_the_covariances_widens_the_answer() -> None:
    off = [0, 0, 0.01, 0.05, 0, 0, 0]
    found = combine_poses([support("a", off), support("b", [-v for v in off])], MIDDLE, ONE, NAMES)
    assert found.covariance is not None
    assert found.covariance[3, 3] > 4 * SIGMAS[3] ** 2


@pytest.mark.parametrize("xi", [[0, 0, 0, 0.8, 0, 0, 0], [0, 0, 0.3, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0, 0.2]])
def test_contradiction_is_no_answer(xi: list[float]) -> None:
    found = combine_poses([support("a", [0] * 7), support("b", xi, 0.99)], MIDDLE, ONE, NAMES)
    assert found.S_map_scan is None
    assert found.covariance is None
    assert found.probability == 0.5
    assert "hall" in found.reason
    assert "kitchen" in found.reason


def test_two_components_are_no_answer() -> None:
    found = combine_poses([support("a", [0] * 7), support("c", [0] * 7, component=1)], MIDDLE, ONE, NAMES)
    assert found.S_map_scan is None
    assert "component 1" in found.reason


def test_where_the_scene_lies_is_carried_to_the_scan() -> None:
    known = np.diag([1e-6] * 3 + [4e-4] * 3 + [1e-8])
    pose = ScenePose("a", Sim3(np.eye(3), np.array([1.0, 0, 0])), 0, "tentative", known)
    registration = Registration(
        "a", "scan", "accepted", S_target_source=POSE, information=np.diag(SIGMAS**-2.0), evidence={"probability": 0.97}
    )
    found = ScanPose.from_registration(pose, registration)
    np.testing.assert_allclose(found.S_map_scan.matrix(), (pose.S_map_scene @ POSE).matrix())
    assert found.tentative
    rng = np.random.default_rng(0)
    scene = exp(rng.normal(size=(4000, 7)) * np.sqrt(np.diag(known)))
    pair = exp(rng.normal(size=(4000, 7)) * SIGMAS)
    truth = found.S_map_scan.inverse()
    offs = np.array(
        [(truth @ (pose.S_map_scene @ scene.item(i) @ POSE @ pair.item(i))).apply(np.zeros(3)) for i in range(4000)]
    )
    np.testing.assert_allclose(np.diag(found.covariance)[3:6], offs.var(0), rtol=0.12)

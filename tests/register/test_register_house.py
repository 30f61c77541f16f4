"""Pairs of a real house and of a real sensor's kitchen, described and registered (slow; needs the captures)."""

import json

import numpy as np
import pytest

from gsmap.describe import describe
from gsmap.evaluate.registration import PoseError, pose_error, scene_centroid
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.ingest import read_captures
from gsmap.register import SceneView, register_pair
from gsmap.types import Registration, Sim3

pytestmark = pytest.mark.slow


def _capture(house, name: str, unit: float = 1.0, policy: str = "auto") -> tuple[SceneView, Sim3]:
    capture = read_captures(house / f"{name}.ply")[0]
    S = Sim3(np.eye(3), np.zeros(3), unit)
    gaussians, cameras = transform_gaussians(capture.gaussians, S), transform_cameras(capture.cameras, S)
    truth = Sim3.from_matrix(np.array(json.loads((house / "truth" / f"{name}.json").read_text())["T_scene_world"]))
    graph = describe(name, gaussians, cameras, scale_policy=policy)
    return SceneView(name, gaussians, cameras, graph, policy), S @ truth


def _error(target: tuple[SceneView, Sim3], source: tuple[SceneView, Sim3]) -> tuple[Registration, PoseError]:
    """The accepted registration of two captures, and how far it is off."""
    found = register_pair(target[0], source[0])
    assert found.status == "accepted"
    truth = target[1] @ source[1].inverse()
    return found, pose_error(found.S_target_source, truth, scene_centroid(source[0].gaussians))


def test_a_quarter_of_overlap_is_enough_and_none_is_not(shared_data):
    house = shared_data / "house"
    c0, c3, c5 = (_capture(house, name) for name in ("c0", "c3", "c5"))
    _, error = _error(c3, c5)
    assert error.rre_deg < 0.1
    assert error.centroid_m < 0.01
    assert register_pair(c0[0], c5[0]).status != "accepted"


def test_an_unknown_unit_is_found(shared_data):
    house = shared_data / "house"
    _, error = _error(_capture(house, "c0", 0.3, "unknown"), _capture(house, "c2", 4.0, "unknown"))
    assert error.rse < 0.005
    assert error.rre_deg < 0.3
    assert error.centroid_m / 0.3 < 0.02


def test_unknown_units_of_a_real_sensor_are_found_and_said_no_surer_than_they_are(shared_data):
    kitchen = shared_data / "kitchen_splats"
    found, error = _error(_capture(kitchen, "k0", 4.0, "unknown"), _capture(kitchen, "k5", 0.3, "unknown"))
    assert error.rse < 0.02  # against the depth sensor, these captures are 0.3 and 1 percent too small
    assert error.rre_deg < 2
    assert error.centroid_m / 4.0 < 0.05
    sigma = np.sqrt(np.linalg.inv(found.information)[6, 6])
    assert error.rse < 2.5 * sigma

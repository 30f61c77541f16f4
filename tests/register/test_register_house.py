"""Pairs of a real house and of a real sensor's kitchen, described and registered (needs the captures).

The first tests describe three captures by their landmarks alone, once; the slow ones describe each in full.
"""

import json

import numpy as np
import pytest

from gsmap.describe import Params as DescribeParams
from gsmap.describe import describe
from gsmap.evaluate.registration import PoseError, pose_error, scene_centroid
from gsmap.geometry.similarities import Similarities
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.ingest import read_captures
from gsmap.register import SceneView, register_pair
from gsmap.types import Registration, Sim3


def _capture(
    house, name: str, unit: float = 1.0, policy: str = "auto", params: DescribeParams | None = None
) -> tuple[SceneView, Sim3]:
    capture = read_captures(house / f"{name}.ply")[0]
    S = Sim3(np.eye(3), np.zeros(3), unit)
    gaussians, cameras = transform_gaussians(capture.gaussians, S), transform_cameras(capture.cameras, S)
    truth = Sim3.from_matrix(np.array(json.loads((house / "truth" / f"{name}.json").read_text())["T_scene_world"]))
    graph = describe(name, gaussians, cameras, params, scale_policy=policy)
    return SceneView(name, gaussians, cameras, graph, policy), S @ truth


def _error(target: tuple[SceneView, Sim3], source: tuple[SceneView, Sim3]) -> tuple[Registration, PoseError]:
    """The accepted registration of two captures, and how far it is off."""
    found = register_pair(target[0], source[0])
    assert found.status == "accepted"
    truth = target[1] @ source[1].inverse()
    return found, pose_error(found.S_target_source, truth, scene_centroid(source[0].gaussians))


@pytest.fixture(scope="module")
def metric(shared_data) -> dict[str, tuple[SceneView, Sim3]]:
    """Three captures whose unit is known to be the metre, by their landmarks alone: 4 to 9 CPU s each."""
    folders = {"c0": "house", "c1": "house", "k0": "kitchen_splats"}
    landmarks = DescribeParams(objects=False)
    return {
        name: _capture(shared_data / folder, name, policy="known", params=landmarks) for name, folder in folders.items()
    }


def test_two_captures_of_a_house_register(metric):
    found, error = _error(metric["c0"], metric["c1"])
    assert found.proposer == "graph:landmarks"
    assert found.num_inliers > 100
    assert error.rre_deg < 0.1
    assert error.centroid_m < 0.01
    assert found.evidence["free_space_violation"] < 0.01
    # The error is about as large as it is said to be: a chi-square with 6 degrees of freedom (22.5 at 0.999).
    truth = metric["c0"][1] @ metric["c1"][1].inverse()
    off = (Similarities.stack([found.S_target_source]).inverse() @ Similarities.stack([truth])).log()[0, :6]
    assert off @ found.information[:6, :6] @ off < 22.5


def test_a_house_and_a_kitchen_share_nothing(metric):
    found = register_pair(metric["c0"][0], metric["k0"][0])
    assert found.status == "no_match"
    assert found.reason.startswith(("not significant: ", "chance explains every proposed pose"))


@pytest.mark.slow
def test_a_quarter_of_overlap_is_enough_and_none_is_not(shared_data):
    house = shared_data / "house"
    c0, c3, c5 = (_capture(house, name) for name in ("c0", "c3", "c5"))
    _, error = _error(c3, c5)
    assert error.rre_deg < 0.1
    assert error.centroid_m < 0.01
    assert register_pair(c0[0], c5[0]).status != "accepted"


@pytest.mark.slow
def test_an_unknown_unit_is_found(shared_data):
    house = shared_data / "house"
    _, error = _error(_capture(house, "c0", 0.3, "unknown"), _capture(house, "c2", 4.0, "unknown"))
    assert error.rse < 0.005
    assert error.rre_deg < 0.3
    assert error.centroid_m / 0.3 < 0.02


@pytest.mark.slow
def test_unknown_units_of_a_real_sensor_are_found_and_said_no_surer_than_they_are(shared_data):
    kitchen = shared_data / "kitchen_splats"
    found, error = _error(_capture(kitchen, "k0", 4.0, "unknown"), _capture(kitchen, "k5", 0.3, "unknown"))
    assert error.rse < 0.02  # against the depth sensor, these captures are 0.3 and 1 percent too small
    assert error.rre_deg < 2
    assert error.centroid_m / 4.0 < 0.05
    sigma = np.sqrt(np.linalg.inv(found.information)[6, 6])
    assert error.rse < 2.5 * sigma

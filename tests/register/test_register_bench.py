"""The methods that tools/bench/register.py compares run, and those that should find an easy pair do."""

import pytest
from register_worlds import splat_world

from gsmap.evaluate.registration import pose_error, scene_centroid
from gsmap.types import Sim3
from tools.bench.registration_methods import ABLATIONS, METHODS, Capture

UNSURE = ("no-context", "no-distance", "no-clique", "fpfh-nodes")  # what may well miss


@pytest.fixture(scope="module")
def captures():
    world = splat_world(0, points=20_000, cut_m=(5.5, 0.5))
    target = Capture("target", "place", world.target, Sim3.identity())
    return target, Capture("source", "place", world.source, world.S_target_source.inverse())


@pytest.mark.parametrize("name", [name for name in ABLATIONS if name.endswith(":landmarks")])
def test_ablations_propose(captures, name):
    answer = ABLATIONS[name](*captures)
    if not name.startswith(UNSURE):
        _check(captures, answer.pose)


@pytest.mark.parametrize("name", ["gsmap", "kiss-0.2", "teaser-style", "mac-style"])
def test_methods_find_an_easy_pair(captures, name):
    if name != "gsmap":
        pytest.importorskip("kiss_matcher" if "kiss" in name else "open3d")
    answer = METHODS[name](*captures)
    if name != "mac-style":  # which takes a quarter turn of this bare room for better
        _check(captures, answer.pose)


def _check(captures, pose):
    target, source = captures
    true = target.S_scene_world @ source.S_scene_world.inverse()
    error = pose_error(pose, true, scene_centroid(source.view.gaussians))
    assert error.rre_deg < 1
    assert error.centroid_m < 0.05

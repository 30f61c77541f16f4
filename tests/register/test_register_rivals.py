"""Rival poses: found, recorded, and never decided by a coin."""

import numpy as np
import pytest
from register_worlds import HALF_TURN, splat_world, two_pose_world

from gsmap.evaluate.registration import pose_error
from gsmap.register import Params, register_pair
from gsmap.register.metric import MetricScene
from gsmap.register.proposers import graph


def _close(found, true) -> bool:
    error = pose_error(found, true, np.zeros(3))
    return bool(error.rre_deg < 2 and error.centroid_m < 0.3)


def test_a_smaller_set_that_moved_on_its_own_is_the_runner_up():
    world, S_second = two_pose_world(first=40, second=30)
    target, source = world.graphs()
    best, rival = graph.propose_by_kind(target, source, "landmarks")
    assert _close(best.S_target_source, world.S_target_source)
    assert _close(rival.S_target_source, S_second)
    assert best.runner_up == rival.num_inliers / best.num_inliers
    assert 0.6 <= best.runner_up < 0.9
    assert rival.runner_up == pytest.approx(1 / best.runner_up)


def test_a_set_too_small_to_be_a_rival_is_none():
    world, _ = two_pose_world(first=40, second=10)
    (only,) = graph.propose_by_kind(*world.graphs(), "landmarks")
    assert only.runner_up == 0.0
    lenient = graph.propose_by_kind(*world.graphs(), "landmarks", graph.Params(rival_share=0.2))
    assert len(lenient) == 2


@pytest.fixture(scope="module")
def symmetric():
    return splat_world(3, symmetric=True, cut_m=(6.5, -0.5), points=20_000, policy="known")


def test_a_room_that_looks_the_same_after_half_a_turn_is_ambiguous(symmetric):
    found = register_pair(symmetric.target, symmetric.source, Params(fallback="never"))
    assert found.status == "no_match"
    assert found.reason.startswith("ambiguous: two poses lie 180 deg and")
    assert found.S_target_source is None
    assert found.information is None
    assert found.evidence["runner_up"] > 0.7
    assert found.evidence["log_nfa"] < -8


def test_both_poses_of_the_symmetric_room_are_proposed(symmetric):
    scenes = (MetricScene(view, 1.0, Params()) for view in (symmetric.target, symmetric.source))
    proposals = graph.propose(*scenes)
    wanted = symmetric.S_target_source, HALF_TURN @ symmetric.S_target_source
    for S in wanted:
        assert any(_close(p.S_target_source, S) for p in proposals)

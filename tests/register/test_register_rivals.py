"""Rival poses: found, recorded, and never decided by a coin."""

import numpy as np
import pytest
from register_worlds import HALF_TURN, layer, splat_world, two_pose_world

from gsmap.evaluate.registration import pose_error
from gsmap.geometry.rotations import exp_so3
from gsmap.register import Params, register_pair
from gsmap.register.metric_scene import MetricScene
from gsmap.register.proposers import graph
from gsmap.types import SceneGraph, Sim3


def _close(found, true) -> bool:
    error = pose_error(found, true, np.zeros(3))
    return bool(error.rre_deg < 2 and error.centroid_m < 0.3)


@pytest.mark.guards("answers")
def test_a_smaller_set_that_moved_on_its_own_is_the_runner_up():
    world, S_second = two_pose_world(first=40, second=30)
    target, source = world.graphs()
    best, rival = graph.propose_by_kind(target, source, "landmarks")
    assert _close(best.S_target_source, world.S_target_source)
    assert _close(rival.S_target_source, S_second)
    assert best.runner_up == rival.num_inliers / best.num_inliers
    assert 0.6 <= best.runner_up < 0.9
    assert rival.runner_up == pytest.approx(1 / best.runner_up)


def test_a_set_too_small_to_be_a_rival_is_none(monkeypatch):
    world, _ = two_pose_world(first=40, second=10)
    (only,) = graph.propose_by_kind(*world.graphs(), "landmarks")
    assert only.runner_up == 0.0
    monkeypatch.setattr(graph, "RIVAL_SHARE", 0.2)
    lenient = graph.propose_by_kind(*world.graphs(), "landmarks")
    assert len(lenient) == 2


def _corridor(seed: int, periods: int, landmarks: int) -> tuple[SceneGraph, SceneGraph, Sim3]:
    """Two scenes of one corridor that repeats itself every three metres, and some landmarks of its own.

    Nodes of different periods are nearly alike, so that each finds its own partner most similar: no node is left over
    for a pose that is one period off.
    """
    rng = np.random.default_rng(seed)
    one = rng.uniform(0, 1, (12, 3)) * [3.0, 2.0, 2.5]
    own = np.c_[rng.uniform(0, 3 * periods, landmarks), rng.uniform(0, 1, (landmarks, 2)) * [2.0, 2.5]]
    points = np.concatenate([one + 3.0 * k * np.eye(3)[0] for k in range(periods)] + [own])
    features = np.concatenate([np.tile(rng.normal(size=(12, 16)), (periods, 1)), rng.normal(size=(landmarks, 16))])
    features = features + rng.normal(size=features.shape) * 0.012
    S = Sim3(exp_so3(rng.normal(size=3)), rng.normal(size=3) * 5)
    layers = []
    for move in (Sim3.identity(), S.inverse()):
        seen = move.apply(points) + rng.normal(size=points.shape) * 0.01
        embeddings = features + rng.normal(size=features.shape) * 0.02
        layers.append(
            layer(rng, len(points), positions=seen, embeddings=embeddings, type_ids=np.zeros(len(points), int))
        )
    target, source = (SceneGraph(str(k), {"landmarks": one}) for k, one in enumerate(layers))
    return target, source, S


def test_a_pose_one_period_off_is_the_rival_where_a_scene_repeats_itself():
    target, source, S = _corridor(1, 8, 0)
    best, rival = graph.propose_by_kind(target, source, "landmarks")
    assert _close(best.S_target_source, S)
    assert best.runner_up == pytest.approx(7 / 8, abs=0.12)  # all but the period at an end
    off = rival.S_target_source.apply(np.zeros(3)) - S.apply(np.zeros(3))
    assert np.linalg.norm(off) == pytest.approx(3.0, abs=0.1)
    assert rival.log_nfa == pytest.approx(best.log_nfa * best.runner_up)
    # Once that is known, the next one lies on the other side, or farther.
    again = best.support.rival(best.S_target_source, best.log_nfa, [rival.S_target_source])
    assert np.linalg.norm(again.S_target_source.apply(np.zeros(3)) - S.apply(np.zeros(3)) - off) > 2.5
    # What chance makes of so many is told of the rival's pose, too.
    inliers, log_nfa = rival.support.count(rival.S_target_source)
    assert inliers > 0.7 * rival.num_inliers
    assert log_nfa == rival.log_nfa


def test_a_scene_that_repeats_itself_before_much_of_its_own_has_no_rival():
    target, source, S = _corridor(1, 4, 120)
    (best,) = graph.propose_by_kind(target, source, "landmarks")
    assert _close(best.S_target_source, S)
    assert best.runner_up == 0.0


@pytest.fixture(scope="module")
def symmetric():
    return splat_world(3, symmetric=True, cut_m=(6.5, -0.5), points=20_000, policy="known")


@pytest.mark.guards("answers")
def test_a_room_that_looks_the_same_after_half_a_turn_is_ambiguous(symmetric):
    found = register_pair(symmetric.target, symmetric.source, Params(fallback="never"))
    assert found.status == "no_match"
    assert found.reason.startswith("ambiguous: two poses lie 180 deg and")
    assert found.S_target_source is None
    assert found.information is None
    assert found.evidence["runner_up"] > 0.7
    assert found.evidence["log_nfa"] < -8


def test_both_poses_of_the_symmetric_room_are_proposed(symmetric):
    scenes = (MetricScene(view, 1.0) for view in (symmetric.target, symmetric.source))
    proposals = graph.propose(*scenes)
    wanted = symmetric.S_target_source, HALF_TURN @ symmetric.S_target_source
    for S in wanted:
        assert any(_close(p.S_target_source, S) for p in proposals)

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_worlds import information, poses_at, true_edges
from raising import raises

from gsmap.errors import ConfigError, InputError
from gsmap.optimize import Params, optimize
from gsmap.types import Edge, Prior, Sim3

IDS = list("abcd")
TRUTH = poses_at(np.arange(4)[:, None] * [3.0, 1, 0])
GOOD = true_edges(TRUTH, [[0, 1], [1, 2], [0, 2], [2, 3]], np.random.default_rng(0), IDS)


def broken(information_matrix):
    return [*GOOD[:3], replace(GOOD[3], information=information_matrix)]


def singular():
    return np.diag([1.0] * 6 + [0.0])


def indefinite():
    out = np.eye(7)
    out[0, 1] = out[1, 0] = 2.0
    return out


def lopsided():
    out = np.eye(7)
    out[0, 1] = 0.5
    return out


@pytest.mark.parametrize(
    ("edges", "code", "match"),
    [
        (broken(np.full((7, 7), np.nan)), "not_finite", "NaN"),
        (broken(singular()), "invalid_information", "positive definite"),
        (broken(indefinite()), "invalid_information", "positive definite"),
        (broken(lopsided()), "invalid_information", "not symmetric"),
        (broken(np.eye(6)), "invalid_information", r"\(7, 7\) .*\(6, 6\)"),
        ([*GOOD, replace(GOOD[3], target="c", source="zz")], "unknown_scene", "'zz'"),
        ([*GOOD, replace(GOOD[3], target="c", source="c")], "self_edge", "c:c "),
        ([*GOOD, GOOD[3]], "duplicate", "c:d is given twice"),
    ],
)
def test_an_unusable_edge_is_named(edges, code, match):
    with raises(InputError, code=code, match=match) as caught:
        optimize(IDS, edges)
    assert "edge c:" in str(caught.value)


def test_not_a_rotation_cannot_become_an_edge():
    with raises(InputError, code="invalid_pose", match="orthonormal"):
        Sim3(1.5 * np.eye(3), np.zeros(3))


@pytest.mark.parametrize(
    "prior",
    [
        Prior("zz", Sim3.identity(), np.ones(7)),
        Prior("a", Sim3.identity(), np.r_[np.ones(6), 0]),
        Prior("a", Sim3.identity(), np.r_[np.ones(6), np.nan]),
        Prior("a", Sim3.identity(), np.ones(6)),
        Prior("a", Sim3.identity(), np.full(7, np.inf), up=np.zeros(3)),
    ],
)
def test_an_unusable_prior_is_named(prior):
    with raises(InputError, code=("unknown_scene", "invalid_sigma", "invalid_prior"), match=prior.scene):
        optimize(IDS, GOOD, [prior])


def test_contradictory_confirmations_are_named():
    shifted = GOOD[2].S_target_source @ Sim3(np.eye(3), np.array([5.0, 0, 0]))
    edges = [replace(GOOD[0], confirmed=True), replace(GOOD[1], confirmed=True)]
    edges.append(replace(GOOD[2], confirmed=True, S_target_source=shifted))
    with raises(InputError, code="confirmed_edges_contradict"):
        optimize(IDS, edges)


def test_a_confirmed_edge_outvotes_edges_nobody_confirmed():
    shifted = GOOD[2].S_target_source @ Sim3(np.eye(3), np.array([5.0, 0, 0]))
    word = replace(GOOD[2], confirmed=True, S_target_source=shifted)
    answer = optimize(IDS, [GOOD[0], GOOD[1], word, GOOD[3]])
    assert answer.use("a", "c") == "used"
    assert "used" not in (answer.use("a", "b"), answer.use("b", "c"))


def test_a_scene_listed_twice_and_odd_parameters():
    with raises(InputError, code="duplicate", match="scene 'a'"):
        optimize(["a", "a"], [])
    with pytest.raises(ConfigError):
        Params(gate_probability=1.0)


def test_nothing_at_all():
    assert optimize([], []).poses == {}
    lonely = optimize(["a"], [])
    assert lonely.poses["a"].status == "isolated"
    assert np.array_equal(lonely.poses["a"].S_map_scene.matrix(), np.eye(4))


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_any_edges_give_an_answer_or_a_named_error(data):
    """Whatever is thrown at it, the optimiser answers with finite poses or raises `InputError`."""
    count = data.draw(st.integers(1, 6))
    ids = [f"s{k}" for k in range(count)]
    scale = st.sampled_from([1.0, 1.0, 0.1, 7.0])
    entry = st.sampled_from([1e-6, 1.0, 1e4, 1e12, 0.0, -1.0, float("nan"), float("inf")])
    edges = []
    for _ in range(data.draw(st.integers(0, 8))):
        a, b = data.draw(st.integers(0, count)), data.draw(st.integers(0, count))
        pose = poses_at(np.array([data.draw(st.tuples(*[st.floats(-1e3, 1e3)] * 3))]), data.draw(st.integers(0, 99)))
        pose = Sim3(pose.rotations[0], pose.translations[0], data.draw(scale))
        sane = data.draw(st.integers(0, 3)) > 0
        info = information(log_scale=0.1) if sane else np.diag(data.draw(st.tuples(*[entry] * 7)))
        edges.append(Edge(f"s{a}", f"s{b}", pose, info, data.draw(st.booleans())))
    try:
        answer = optimize(ids, edges)
    except InputError as problem:
        if "edge" in str(problem):
            return
        raise
    assert set(answer.poses) == set(ids)
    assert set(answer.outcomes) == {(e.target, e.source) for e in edges}
    assert all(outcome.reason for outcome in answer.outcomes.values() if outcome.use != "used")

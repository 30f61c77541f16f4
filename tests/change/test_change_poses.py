"""Poses about the vertical, found by votes and settled by ICP."""

import numpy as np
import pytest

from gsmap._native import FeatureTree, vote_shifts
from gsmap.change.poses import features, refine_pose, rotation_about_up, vote_poses
from gsmap.types import Sim3


@pytest.fixture
def chair():
    """Cells of something with two colours and no symmetry, away from the origin."""
    rng = np.random.default_rng(0)
    points = np.concatenate(
        [rng.uniform((0, 0, 0), (0.9, 0.3, 0.4), (250, 3)), rng.uniform((0, 0, 0.4), (0.3, 0.3, 1), (150, 3))]
    )
    colours = np.where(points[:, 2:] < 0.4, (0.7, 0.2, 0.2), (0.2, 0.3, 0.7))
    return points + np.array([3.0, -1.0, 0.0]), colours


def test_a_pose_is_voted_for_and_settled(chair):
    points, colours = chair
    truth = Sim3(rotation_about_up(0.6), np.array([0.8, -0.3, 0.0]))
    there = truth.apply(points)
    start = vote_poses(points, colours, there, colours, 24)[0][1]
    found = refine_pose(
        features(points, colours), FeatureTree(features(there, colours)), start, (0.12, 0.1, 0.08, 0.06, 0.04, 0.03)
    )
    np.testing.assert_allclose(found.apply(points), there, atol=0.01)


def test_what_stands_on_a_floor_does_not_rise(chair):
    points, colours = chair
    tree = FeatureTree(features(points + np.array([0, 0, 0.2]), colours))
    found = refine_pose(features(points, colours), tree, Sim3.identity(), (0.3,) * 5)
    assert found.translation[2] == pytest.approx(0.04)


def test_where_nothing_is_near_the_start_stays(chair):
    points, colours = chair
    start = Sim3(rotation_about_up(0.3), np.array([0.1, 0.2, 0.0]))
    far = FeatureTree(features(points + np.array([9, 0, 0]), colours))
    found = refine_pose(features(points, colours), far, start, (0.2, 0.1))
    np.testing.assert_array_equal(found.matrix(), start.matrix())
    assert np.isinf(far.distances(features(points, colours), 1.0)).all()


def test_the_most_voted_shift_comes_first():
    a = np.random.default_rng(1).uniform(-1, 1, (40, 2))
    b = np.concatenate([a[:30] + np.array([2.0, 0.5]), a[30:] - 1.0])
    which, peaks = vote_shifts(a, b, np.arange(40), np.arange(40), np.ones(40), np.zeros(1), 0.1, 2)
    np.testing.assert_array_equal(which, [0, 0])
    np.testing.assert_allclose(peaks, [[30, 2.0, 0.5], [10, -1.0, -1.0]], atol=1e-9)
    for wrong in (-1, 40):
        with pytest.raises(ValueError, match="ends"):
            vote_shifts(a, b, np.full(40, wrong), np.arange(40), np.ones(40), np.zeros(1), 0.1, 2)

"""Nearest neighbours are those of a k-d tree, whatever the order they are looked at in."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gsmap.geometry import neighbours
from gsmap.geometry.neighbours import chunks_of_neighbours, nearest_neighbours, nearest_of, neighbours_of, spatial_order


@pytest.mark.parametrize("count", [0, 1, 5, 25, 3000, 20_000])
def test_neighbours_are_those_of_a_search_tree(count, monkeypatch):
    monkeypatch.setattr(neighbours, "_CHUNK", 700)
    points = np.random.default_rng(count).normal(size=(count, 3)) * [5, 1, 0.2]
    distances, rows = nearest_neighbours(points, 6)
    assert distances.shape == rows.shape == (count, 6)
    if count:
        near, of = cKDTree(points).query(points, k=6)
        np.testing.assert_allclose(distances, near)
        np.testing.assert_array_equal(rows, of)
    seen = [r for r, *_ in chunks_of_neighbours(points, 3)]
    assert sorted(np.concatenate([*seen, []]).astype(int)) == list(range(count))


def test_points_in_one_place_keep_their_order():
    np.testing.assert_array_equal(spatial_order(np.ones((4, 3)), 8), np.arange(4))
    points = np.array([[0.0, 0, 0], [9, 0, 0], [0.1, 0, 0], [9.1, 0, 0]])
    np.testing.assert_array_equal(spatial_order(points, 4), [0, 2, 1, 3])


def test_the_nearest_of_other_points_is_that_of_a_search_tree():
    rng = np.random.default_rng(4)
    points, at = rng.normal(size=(500, 3)), rng.normal(size=(300, 3))
    far, row = cKDTree(points).query(at)
    distances, rows = nearest_of(points, at)
    np.testing.assert_allclose(distances, far)
    np.testing.assert_array_equal(rows, row)
    distances, rows = nearest_of(points, at, 0.2)
    np.testing.assert_array_equal(np.isfinite(distances), far < 0.2)
    np.testing.assert_array_equal(rows[far < 0.2], row[far < 0.2])


@pytest.mark.parametrize("radius", [np.inf, 0.3])
def test_several_nearest_of_other_points_are_those_of_a_search_tree(radius):
    rng = np.random.default_rng(5)
    points, at = rng.normal(size=(500, 3)), rng.normal(size=(300, 3))
    far, row = cKDTree(points).query(at, 7, distance_upper_bound=radius)
    distances, rows = neighbours_of(points, at, 7, radius)
    np.testing.assert_allclose(distances, far)
    np.testing.assert_array_equal(rows, row)
    assert np.isinf(radius) == np.isfinite(distances).all()

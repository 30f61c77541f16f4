"""Boxes, against those counted by hand."""

import numpy as np

from gsmap.geometry.boxes import are_finite, box_around, box_corners, box_overlaps


def test_corners_come_in_the_order_of_their_bits():
    corners = box_corners(np.array([[0, 1, 2], [5, 6, 7]]))
    expected = [[0, 1, 2], [5, 1, 2], [0, 6, 2], [5, 6, 2], [0, 1, 7], [5, 1, 7], [0, 6, 7], [5, 6, 7]]
    assert corners.tolist() == expected


def test_a_box_around_points_keeps_what_they_are_counted_in():
    for kind in (np.float32, np.float64, np.int64):
        box = box_around(np.array([[3, -1, 2], [0, 7, 2], [1, 1, -5]], kind))
        assert box.dtype == kind
        assert box.tolist() == [[0, -1, -5], [3, 7, 2]]


def test_points_are_finite_where_all_three_numbers_are():
    points = np.zeros((5, 3))
    points[1, 0], points[2, 1], points[3, 2] = np.nan, np.inf, -np.inf
    assert are_finite(points).tolist() == [True, False, False, False, True]


def test_overlaps_are_shares_of_the_union_of_padded_boxes():
    unit = np.array([[0.0, 0, 0], [1, 1, 1]])
    boxes = np.array([unit, unit + np.array([0.5, 0, 0]), unit + 2])
    np.testing.assert_allclose(box_overlaps(unit[None], boxes), [[1, 1 / 3, 0]])
    wall = np.array([[[0.0, 0, 0], [1, 1, 0]]])
    np.testing.assert_allclose(box_overlaps(wall, wall + np.array([0.5, 0, 0]), 0.25), [[1 / 2]])

"""The corners of a box, against those counted by hand."""

import numpy as np

from gsmap.geometry.boxes import box_corners


def test_corners_come_in_the_order_of_their_bits():
    corners = box_corners(np.array([[0, 1, 2], [5, 6, 7]]))
    expected = [[0, 1, 2], [5, 1, 2], [0, 6, 2], [5, 6, 2], [0, 1, 7], [5, 1, 7], [0, 6, 7], [5, 6, 7]]
    assert corners.tolist() == expected

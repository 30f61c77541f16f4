"""Directions turned to the vertical, and spread over the sphere."""

import numpy as np
import pytest

from gsmap.geometry.directions import fibonacci_sphere, level_frame, rotation_to_z
from gsmap.geometry.rotations import angle_between

UPS = [[0, 0, 1], [0, 0, -1], [1, 0, 0], [0, -1, 0], [0.6, 0, 0.8], [0.6, 0, -0.8], [1e-3, 0, -1]]


@pytest.mark.parametrize("up", UPS)
def test_up_goes_to_z_by_a_proper_rotation(up):
    up = np.array(up, float) / np.linalg.norm(up)
    for rotation in (rotation_to_z(up), level_frame(up)):
        np.testing.assert_allclose(rotation @ up, [0, 0, 1], atol=1e-9)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(rotation) == pytest.approx(1)


@pytest.mark.parametrize("up", UPS)
def test_the_rotation_to_z_is_the_shortest(up):
    up = np.array(up, float) / np.linalg.norm(up)
    angle = np.arctan2(np.linalg.norm(np.cross(up, [0, 0, 1])), up[2])
    assert angle_between(np.eye(3), rotation_to_z(up)) == pytest.approx(angle, abs=1e-5)


def test_a_level_frame_depends_on_the_direction_alone():
    np.testing.assert_allclose(level_frame(np.array([0.3, 2, -1])), level_frame(np.array([3.0, 20, -10])), atol=1e-15)


def test_spread_directions_are_even():
    points = fibonacci_sphere(400)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1)
    assert points[0, 2] > 0.99
    assert points[-1, 2] < -0.99
    # Even: the integral of every polynomial of degree 2 is that over the sphere, and neighbours are equally far.
    np.testing.assert_allclose(points.mean(0), 0, atol=2e-3)
    np.testing.assert_allclose(points.T @ points / 400, np.eye(3) / 3, atol=2e-3)
    cosines = points @ points.T - 2 * np.eye(400)
    nearest = np.arccos(cosines.max(1))
    assert nearest.max() < 1.6 * nearest.min()

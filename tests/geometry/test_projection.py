"""Pinhole projection against points laid out by hand, and against homogeneous coordinates."""

import numpy as np
import pytest

from gsmap.geometry.projection import in_image, on_surface, project, project_all

INTRINSICS = np.array([100.0, 200.0, 32.0, 24.0])


def test_a_point_ahead_falls_on_the_principal_point_and_axes_are_right_and_down():
    points = np.array([[0.0, 0, 2], [0.1, 0, 2], [0, 0.1, 2], [0, 0, -2]])
    pixels, depth = project(points, np.eye(4), INTRINSICS)
    np.testing.assert_allclose(pixels[:3], [[32, 24], [37, 24], [32, 34]])
    np.testing.assert_array_equal(depth, [2, 2, 2, -2])


def test_frame_to_camera_is_applied_before():
    rng = np.random.default_rng(0)
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    T[:3, 3] = [0.3, -0.2, 5]
    points = rng.uniform(-1, 1, (50, 3))
    fx, fy, cx, cy = INTRINSICS
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    image = (K @ (T @ np.c_[points, np.ones(50)].T)[:3]).T
    pixels, depth = project(points, T, INTRINSICS)
    np.testing.assert_allclose(pixels, image[:, :2] / image[:, 2:], rtol=1e-12)
    np.testing.assert_allclose(depth, image[:, 2], rtol=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_answer_has_the_precision_of_the_points(dtype):
    pixels, depth = project(np.array([[0.1, 0.2, 3]], dtype), np.eye(4), INTRINSICS)
    assert pixels.dtype == depth.dtype == dtype


def test_inside_means_before_the_camera_beyond_near_and_within_half_open_borders():
    pixels = np.array([[0, 0], [63.9, 47.9], [64, 10], [10, 48], [-0.1, 5], [5, -0.1], [5, 5], [5, 5], [np.nan, 5]])
    depth = np.array([1, 1, 1, 1, 1, 1, 0, -1, 1.0])
    inside = in_image(pixels, depth, np.array([64, 48]))
    assert inside.tolist() == [True, True, False, False, False, False, False, False, False]
    assert in_image(pixels[:2], np.array([0.5, 2.0]), np.array([64, 48]), near=0.5).tolist() == [False, True]


def test_many_images_at_once_are_as_each_by_itself():
    rng = np.random.default_rng(1)
    points = rng.uniform(-1, 1, (300, 3)).astype(np.float32)
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, :3] = np.linalg.qr(rng.normal(size=(5, 3, 3)))[0]
    poses[:, :3, 3] = rng.normal(size=(5, 3))
    intrinsics = INTRINSICS + rng.uniform(0, 9, (5, 4))
    column, row, depth = project_all(points, poses, intrinsics)
    for c in range(5):
        pixels, z = project(points, poses[c], intrinsics[c])
        np.testing.assert_array_equal(np.stack([column[c], row[c]], axis=1), pixels)
        np.testing.assert_array_equal(depth[c], z)


@pytest.mark.parametrize("tolerance", [0.05, np.inf])
def test_points_on_a_surface_are_those_at_the_depth_of_their_pixel(tolerance):
    rng = np.random.default_rng(2)
    points = rng.uniform(-2, 2, (4000, 3))
    view = np.eye(4)
    view[:3, 3] = 0.1, -0.2, 1.5
    intrinsics, depth = np.array([30.0, 35.0, 16.5, 11.0]), rng.uniform(0.5, 3, (24, 32)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.3] = 0
    pixels, z = project(points, view, intrinsics)
    inside = np.flatnonzero(in_image(pixels, z, np.array([32, 24])))
    column, row = np.floor(pixels[inside]).astype(int).T
    at = depth[row, column]
    on = (at > 0) & (np.abs(z[inside] - at) < tolerance * at)
    rows, found = on_surface(points, view, intrinsics, depth, tolerance)
    assert 20 < on.sum() < len(inside)
    np.testing.assert_array_equal(rows, inside[on])
    np.testing.assert_array_equal(found, np.stack([column, row], 1)[on])

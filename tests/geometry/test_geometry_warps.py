"""Warps beside finite differences, and Gaussians beside points that are drawn from them."""

from __future__ import annotations

import numpy as np

from gsmap.geometry.rotations import quats_to_matrices
from gsmap.geometry.warps import REACH, Warp, warp_cameras, warp_gaussians
from gsmap.types import Cameras, Gaussians


def example(seed: int = 0) -> Warp:
    rng = np.random.default_rng(seed)
    strain, bend = rng.normal(0, 0.02, (3, 3)), rng.normal(0, 0.03, (3, 3, 3))
    return Warp(rng.normal(size=3), 2.0, strain + strain.T, bend + bend.transpose(0, 2, 1))


def test_a_point_moves_by_strain_and_bend() -> None:
    warp = Warp(np.array([1.0, 0.0, 0.0]), 2.0, np.diag([0.1, 0.0, 0.0]), np.zeros((3, 3, 3)))
    warp.bend[2, 1, 1] = 0.05
    # x: 3 + 0.1 (3 - 1); z: 0 + 2 * 0.05 (4 / 2)^2
    np.testing.assert_allclose(warp.apply(np.array([[3.0, 4.0, 0.0]])), [[3.2, 4.0, 0.4]])
    # Beyond its reach the bend continues along its tangent: y = 10 is 5 radii away.
    tangent = 0.05 * (REACH**2 + 2 * REACH * (5.0 - REACH)) * 2
    np.testing.assert_allclose(warp.apply(np.array([[1.0, 10.0, 0.0]])), [[1.0, 10.0, tangent]])


def test_jacobians_are_the_derivatives() -> None:
    warp, step = example(), 1e-6
    points = np.random.default_rng(1).normal(0, 4, (200, 3))  # on both sides of the reach
    far = np.linalg.norm(points - warp.centre, axis=1) > REACH * warp.radius
    assert 20 < far.sum() < 180
    numeric = np.stack(
        [(warp.apply(points + e) - warp.apply(points - e)) / (2 * step) for e in step * np.eye(3)], axis=2
    )
    np.testing.assert_allclose(warp.jacobians(points), numeric, atol=1e-7)


def test_a_scaled_warp_moves_scaled_points() -> None:
    warp, points = example(), np.random.default_rng(1).normal(0, 4, (50, 3))
    np.testing.assert_allclose(warp.scaled(0.3).apply(0.3 * points), 0.3 * warp.apply(points), atol=1e-12)


def test_no_point_of_a_box_moves_farther_than_stated() -> None:
    for seed in range(10):
        warp, rng = example(seed), np.random.default_rng(seed)
        bounds = np.sort(rng.uniform(-8, 8, (2, 3)), axis=0)
        points = rng.uniform(*bounds, (20_000, 3))
        moved = np.linalg.norm(warp.apply(points) - points, axis=1).max()
        assert moved <= warp.largest_motion(bounds) <= 1.5 * moved + 0.05


def test_a_warped_gaussian_holds_the_warped_points() -> None:
    rng, warp = np.random.default_rng(3), example()
    quats = rng.normal(size=(5, 4)).astype(np.float32)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    gaussians = Gaussians(
        rng.normal(size=(5, 3)).astype(np.float32),
        quats,
        np.log(rng.uniform(0.005, 0.02, (5, 3))).astype(np.float32),
        np.zeros(5, np.float32),
        rng.normal(size=(5, 4, 3)).astype(np.float32),
        np.array([0.5, 0.0, -0.5]),
    )
    warped = warp_gaussians(gaussians, warp)
    np.testing.assert_array_equal(warped.sh, gaussians.sh)
    np.testing.assert_array_equal(warped.origin, gaussians.origin)
    for k in range(5):
        axes = quats_to_matrices(gaussians.quats[k : k + 1].astype(np.float64))[0] * np.exp(gaussians.log_scales[k])
        points = warp.apply(gaussians.positions[k] + rng.normal(size=(200_000, 3)) @ axes.T)
        np.testing.assert_allclose(warped.positions[k], points.mean(0), atol=2e-4)
        shape = quats_to_matrices(warped.quats[k : k + 1].astype(np.float64))[0] * np.exp(warped.log_scales[k])
        np.testing.assert_allclose(shape @ shape.T, np.cov(points.T), atol=5e-6)


def test_a_warped_camera_stays_rigid_and_sees_what_it_saw() -> None:
    warp, pose = example(), np.eye(4)
    pose[:3, 3] = [0.3, -0.2, 1.0]
    cameras = Cameras(pose[None], np.array([[300.0, 300.0, 160.0, 120.0]]), np.array([[320, 240]]))
    moved = warp_cameras(cameras, warp).T_frame_camera[0]
    np.testing.assert_allclose(moved[:3, :3] @ moved[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(moved[:3, :3]) > 0
    np.testing.assert_allclose(moved[:3, 3], warp.apply(pose[None, :3, 3])[0])
    # A point on its axis stays near the axis.
    ahead = warp.apply(np.array([[0.3, -0.2, 1.5]]))[0]
    seen = moved[:3, :3].T @ (ahead - moved[:3, 3])
    assert np.hypot(seen[0], seen[1]) / seen[2] < 0.08

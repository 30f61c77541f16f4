import numpy as np
import pytest

from gsmap.geometry.rotations import quats_to_matrices
from gsmap.geometry.transforms import (
    rotate_sh,
    sh_basis,
    sh_rotation_matrix,
    transform_cameras,
    transform_gaussians,
)
from gsmap.types import Cameras, Gaussians, Sim3


def random_rotation(rng):
    return quats_to_matrices(rng.normal(size=4))


def random_gaussians(rng, n=200, degree=3):
    return Gaussians(
        rng.normal(size=(n, 3)),
        rng.normal(size=(n, 4)),
        rng.normal(-2.5, 0.4, size=(n, 3)),
        rng.normal(size=n),
        rng.normal(0, 0.3, size=(n, (degree + 1) ** 2, 3)),
    )


def covariances(g):
    matrix = quats_to_matrices(g.quats) * g.scales[:, None, :]
    return matrix @ matrix.transpose(0, 2, 1)


def test_sh_basis_is_orthonormal():
    # 16-point Gauss-Legendre in z times 32 equal angles integrates products of two degree-3 harmonics exactly.
    z, weight = np.polynomial.legendre.leggauss(16)
    angle = np.arange(32) * 2 * np.pi / 32
    radius = np.sqrt(1 - z**2)
    directions = np.stack(
        [np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle)), np.repeat(z[:, None], 32, 1)], axis=-1
    ).reshape(-1, 3)
    weights = np.repeat(weight, 32) * 2 * np.pi / 32
    basis = sh_basis(directions, 3)
    np.testing.assert_allclose(basis.T @ (basis * weights[:, None]), np.eye(16), atol=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_rotated_sh_shows_the_same_colour_along_the_rotated_direction(degree):
    rng = np.random.default_rng(degree)
    rotation = random_rotation(rng)
    sh = rng.normal(size=(50, (degree + 1) ** 2, 3)).astype(np.float32)
    directions = rng.normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before = np.einsum("nk,nkc->nc", sh_basis(directions, degree), sh)
    after = np.einsum("nk,nkc->nc", sh_basis(directions @ rotation.T, degree), rotate_sh(sh, rotation))
    np.testing.assert_allclose(after, before, atol=5e-6)


def test_sh_rotation_is_an_orthogonal_representation():
    rng = np.random.default_rng(5)
    a, b = random_rotation(rng), random_rotation(rng)
    wigner = sh_rotation_matrix(a, 3)
    np.testing.assert_allclose(wigner @ wigner.T, np.eye(16), atol=1e-13)
    np.testing.assert_allclose(sh_rotation_matrix(a @ b, 3), wigner @ sh_rotation_matrix(b, 3), atol=1e-13)
    np.testing.assert_allclose(sh_rotation_matrix(np.eye(3), 3), np.eye(16), atol=1e-13)


def test_means_and_covariances_follow_the_similarity():
    rng = np.random.default_rng(1)
    gaussians = random_gaussians(rng)
    S = Sim3(random_rotation(rng), rng.normal(size=3), 2.5)
    moved = transform_gaussians(gaussians, S)
    np.testing.assert_allclose(moved.means, S.apply(gaussians.means), atol=1e-5)
    expected = S.scale**2 * S.rotation @ covariances(gaussians) @ S.rotation.T
    np.testing.assert_allclose(covariances(moved), expected, rtol=1e-4, atol=1e-6)
    np.testing.assert_array_equal(moved.logit_opacities, gaussians.logit_opacities)


def test_colours_turn_with_the_gaussians():
    """What is seen along a direction before is seen along the turned direction after, whatever the scale."""
    rng = np.random.default_rng(6)
    gaussians = random_gaussians(rng)
    S = Sim3(random_rotation(rng), rng.normal(size=3), 0.7)
    moved = transform_gaussians(gaussians, S)
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before = np.einsum("nk,nkc->nc", sh_basis(directions, 3), gaussians.sh)
    after = np.einsum("nk,nkc->nc", sh_basis(directions @ S.rotation.T, 3), moved.sh)
    np.testing.assert_allclose(after, before, atol=1e-5)
    assert np.abs(moved.sh[:, 1:] - gaussians.sh[:, 1:]).max() > 0.1  # they do depend on the direction


def test_there_and_back_is_the_identity():
    rng = np.random.default_rng(2)
    gaussians = random_gaussians(rng)
    S = Sim3(random_rotation(rng), rng.normal(size=3), 0.3)
    back = transform_gaussians(transform_gaussians(gaussians, S), S.inverse())
    for name in ("means", "log_scales", "logit_opacities", "sh"):
        np.testing.assert_allclose(getattr(back, name), getattr(gaussians, name), atol=2e-5)


def test_cameras_keep_their_pixels():
    rng = np.random.default_rng(3)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = random_rotation(rng), rng.normal(size=3)
    cameras = Cameras(T[None], np.array([[300.0, 310, 160, 120]]), np.array([[320, 240]]), ("a",))
    S = Sim3(random_rotation(rng), rng.normal(size=3), 1.7)
    points = rng.normal(size=(20, 3))

    def project(camera, points):
        local = points @ camera.T_camera_frame[0, :3, :3].T + camera.T_camera_frame[0, :3, 3]
        pixel = local @ camera.K[0].T
        return pixel[:, :2] / pixel[:, 2:], local[:, 2]

    pixels, depths = project(cameras, points)
    moved_pixels, moved_depths = project(transform_cameras(cameras, S), S.apply(points))
    np.testing.assert_allclose(moved_pixels, pixels, rtol=1e-9)
    np.testing.assert_allclose(moved_depths, 1.7 * depths, rtol=1e-9)


def test_empty_set_stays_empty():
    assert len(transform_gaussians(Gaussians.empty(3), Sim3.identity())) == 0

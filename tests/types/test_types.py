"""The nouns keep their invariants."""

import numpy as np
import pytest
from raising import raises
from scipy.spatial.transform import Rotation

from gsmap import Cameras, Gaussians, Registration, Sim3
from gsmap.errors import InputError

RNG = np.random.default_rng(7)


def random_sim3() -> Sim3:
    return Sim3(Rotation.random(rng=RNG).as_matrix(), RNG.normal(size=3), float(RNG.uniform(0.2, 5)))


def test_sim3_acts_like_its_matrix() -> None:
    a, b = random_sim3(), random_sim3()
    points = RNG.normal(size=(20, 3))
    homogeneous = np.c_[points, np.ones(20)]
    np.testing.assert_allclose(a.apply(points), (homogeneous @ a.matrix().T)[:, :3], atol=1e-12)
    np.testing.assert_allclose((a @ b).matrix(), a.matrix() @ b.matrix(), atol=1e-12)
    np.testing.assert_allclose((a @ a.inverse()).matrix(), np.eye(4), atol=1e-12)
    np.testing.assert_allclose(Sim3.from_matrix(a.matrix()).matrix(), a.matrix(), atol=1e-12)


def test_sim3_long_chain_stays_a_rotation() -> None:
    step = Sim3(Rotation.from_euler("xyz", [0.1, 0.2, 0.3]).as_matrix(), [1, 0, 0])
    total = Sim3.identity()
    for _ in range(2000):
        total = total @ step
    np.testing.assert_allclose(total.rotation @ total.rotation.T, np.eye(3), atol=1e-13)


@pytest.mark.parametrize(
    ("rotation", "translation", "scale"),
    [
        (np.eye(3) * 1.5, np.zeros(3), 1.0),
        (np.diag([1.0, 1.0, -1.0]), np.zeros(3), 1.0),
        (np.eye(3), np.array([0, np.nan, 0]), 1.0),
        (np.eye(3), np.zeros(3), 0.0),
        (np.eye(3), np.zeros(3), -2.0),
        (np.eye(2), np.zeros(3), 1.0),
    ],
)
def test_sim3_refuses_what_is_not_a_similarity(rotation: np.ndarray, translation: np.ndarray, scale: float) -> None:
    with pytest.raises(InputError):
        Sim3(rotation, translation, scale)


@pytest.mark.parametrize("matrix", [np.diag([1, 2, 1, 1.0]), np.diag([1, 1, -1, 1.0]), np.zeros((4, 4)), np.eye(3)])
def test_sim3_refuses_matrices_that_are_not_similarities(matrix: np.ndarray) -> None:
    with pytest.raises(InputError):
        Sim3.from_matrix(matrix)


def test_gaussians_concatenate_pads_sh() -> None:
    a = Gaussians(np.zeros((2, 3)), np.ones((2, 4)), np.zeros((2, 3)), np.zeros(2), np.ones((2, 1, 3)))
    b = Gaussians(np.ones((3, 3)), np.ones((3, 4)), np.zeros((3, 3)), np.zeros(3), np.ones((3, 9, 3)))
    both = Gaussians.concatenate([a, b])
    assert (len(both), both.sh_degree) == (5, 2)
    assert both.sh[:2, 1:].sum() == 0
    assert len(both[both.means[:, 0] > 0.5]) == 3


def test_gaussians_refuse_shapes_that_do_not_fit() -> None:
    with raises(InputError, code="shape_mismatch", match=r"sh must have shape \(2, K, 3\)"):
        Gaussians(np.zeros((2, 3)), np.ones((2, 4)), np.zeros((2, 3)), np.zeros(2), np.ones((2, 5, 3)))
    with raises(InputError, code="shape_mismatch", match=r"quats must have shape \(2, 4\)"):
        Gaussians(np.zeros((2, 3)), np.ones((3, 4)), np.zeros((2, 3)), np.zeros(2), np.ones((2, 1, 3)))


def cameras(n: int = 3) -> Cameras:
    pose = np.tile(np.eye(4), (n, 1, 1))
    pose[:, :3, :3] = Rotation.random(n, rng=RNG).as_matrix()
    pose[:, :3, 3] = RNG.normal(size=(n, 3))
    return Cameras(pose, np.tile([500.0, 510, 320, 240], (n, 1)), np.tile([640, 480], (n, 1)))


def test_cameras_view_is_the_inverse_of_the_pose() -> None:
    c = cameras()
    np.testing.assert_allclose(c.T_camera_frame @ c.T_frame_camera, np.tile(np.eye(4), (3, 1, 1)), atol=1e-12)
    assert c[1].names == ("1",)
    assert len(c[[0, 2]]) == 2


def test_cameras_resized_see_the_same_rays() -> None:
    c = cameras().resized(200)
    assert c.sizes_px[0].tolist() == [200, 150]
    np.testing.assert_allclose(c.intrinsics_px[0], np.array([500.0, 510, 320, 240]) * 200 / 640)


def test_cameras_name_the_one_that_is_wrong() -> None:
    c = cameras()
    pose = c.T_frame_camera.copy()
    pose[1, 0, 3] = np.nan
    with raises(InputError, code="not_finite", match="camera 1 holds NaN"):
        Cameras(pose, c.intrinsics_px, c.sizes_px)
    pose = c.T_frame_camera.copy()
    pose[2, :3, :3] *= 2
    with raises(InputError, code="invalid_camera", match="camera 2 has a pose"):
        Cameras(pose, c.intrinsics_px, c.sizes_px)


def test_an_accepted_registration_has_a_pose() -> None:
    with raises(InputError, code="invalid_registration"):
        Registration("a", "b", "accepted")
    assert Registration("a", "b", "no_match", "no overlap").S_target_source is None

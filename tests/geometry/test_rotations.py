"""Rotations against scipy, and the closed-form similarity against known answers."""

import numpy as np
import pytest
from raising import raises
from scipy.spatial.transform import Rotation

from gsmap import Sim3
from gsmap.errors import InputError
from gsmap.geometry.rotations import (
    angle_between,
    exp_so3,
    matrices_to_quats,
    multiply_quats,
    quats_to_matrices,
    retract,
    rotation_vector,
    skew,
)
from gsmap.geometry.similarities import rotation_vectors
from gsmap.geometry.umeyama import umeyama

RNG = np.random.default_rng(3)
ROTATIONS = Rotation.random(50, rng=RNG)
WXYZ = ROTATIONS.as_quat()[:, [3, 0, 1, 2]]


def test_quaternions_are_wxyz() -> None:
    np.testing.assert_allclose(quats_to_matrices(WXYZ * 2.5), ROTATIONS.as_matrix(), atol=1e-14)
    back = matrices_to_quats(ROTATIONS.as_matrix())
    assert (back[:, 0] >= 0).all()
    np.testing.assert_allclose(np.abs((back * WXYZ).sum(1)), 1, atol=1e-12)
    np.testing.assert_allclose(quats_to_matrices(np.zeros(4)), np.eye(3))


def test_arrays_that_cannot_be_written_are_read() -> None:
    matrices, vector = ROTATIONS.as_matrix(), ROTATIONS[0].as_rotvec()
    matrices.flags.writeable = vector.flags.writeable = False
    np.testing.assert_allclose(quats_to_matrices(matrices_to_quats(matrices)), matrices, atol=1e-12)
    np.testing.assert_allclose(rotation_vectors(matrices)[0], vector, atol=1e-12)
    np.testing.assert_allclose(exp_so3(vector), matrices[0], atol=1e-12)


def test_product_of_quaternions_is_product_of_rotations() -> None:
    product = quats_to_matrices(multiply_quats(WXYZ[:25], WXYZ[25:]))
    np.testing.assert_allclose(product, ROTATIONS[:25].as_matrix() @ ROTATIONS[25:].as_matrix(), atol=1e-12)


def test_skew_is_the_cross_product() -> None:
    a, b = RNG.normal(size=(2, 10, 3))
    np.testing.assert_allclose(np.einsum("nij,nj->ni", skew(a), b), np.cross(a, b), atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, 3.0, np.pi])
def test_angle_is_exact_down_to_nothing(angle: float) -> None:
    turned = exp_so3(np.array([0.6, 0.0, 0.8]) * angle)
    assert angle_between(np.eye(3), turned) == pytest.approx(angle, rel=1e-6, abs=1e-12)


def test_retract_steps_in_the_source_frame() -> None:
    pose = Sim3(ROTATIONS[0].as_matrix(), [1, 2, 3], 2.0)
    moved = retract(pose, np.array([0, 0, 0, 0.1, 0, 0, 0]))
    np.testing.assert_allclose(moved.translation, pose.apply([0.1, 0, 0]))
    assert retract(pose, np.array([0, 0, 0, 0, 0, 0, np.log(1.5)])).scale == pytest.approx(3.0)


@pytest.mark.parametrize("with_scale", [False, True])
def test_umeyama_recovers_the_similarity(with_scale: bool) -> None:
    truth = Sim3(ROTATIONS[1].as_matrix(), [4, -1, 2], 3.7 if with_scale else 1.0)
    source = RNG.normal(size=(12, 3))
    found = umeyama(truth.apply(source), source, with_scale=with_scale)
    np.testing.assert_allclose(found.matrix(), truth.matrix(), atol=1e-12)


def test_umeyama_stays_proper_on_a_mirrored_set() -> None:
    source = RNG.normal(size=(12, 3))
    found = umeyama(source * [1, 1, -1], source)
    assert np.linalg.det(found.rotation) == pytest.approx(1)


def test_umeyama_scale_of_a_mirrored_set_is_that_of_the_best_proper_similarity() -> None:
    """Umeyama 1991, eq. 43: the sign of the mirrored axis counts in the scale as well as in the rotation."""
    source = RNG.normal(size=(30, 3)) * [1.0, 0.8, 0.6]
    target = 1.7 * (source * [1, 1, -1]) @ ROTATIONS[3].as_matrix().T + [1, 2, 3]
    found = umeyama(target, source, with_scale=True)
    s, t = source - source.mean(0), target - target.mean(0)

    def residual(scale: float) -> float:
        return float(((t - scale * s @ found.rotation.T) ** 2).sum())

    assert residual(found.scale) < min(residual(found.scale * 1.01), residual(found.scale * 0.99))
    assert found.scale < 1.6  # the mirrored axis pulls it below the scale of the two others


def test_umeyama_weights_leave_outliers_out() -> None:
    truth = Sim3(ROTATIONS[2].as_matrix(), [0, 1, 0])
    source = RNG.normal(size=(10, 3))
    target = truth.apply(source)
    target[0] += 5
    found = umeyama(target, source, weights=np.r_[0, np.ones(9)])
    np.testing.assert_allclose(found.matrix(), truth.matrix(), atol=1e-12)


def test_umeyama_refuses_what_has_no_answer() -> None:
    with raises(InputError, code="degenerate_points"):
        umeyama(np.zeros((2, 3)), np.zeros((2, 3)))
    with raises(InputError, code="degenerate_points"):
        umeyama(RNG.normal(size=(5, 3)), np.ones((5, 3)), with_scale=True)


@pytest.mark.parametrize("angle", [0.0, 1e-7, 0.3, 2.0, np.pi - 1e-9, np.pi])
def test_rotation_vector_turns_as_the_matrix_does(angle: float) -> None:
    for axis in np.vstack([np.eye(3), np.random.default_rng(5).normal(size=(20, 3))]):
        matrix = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
        found = rotation_vector(matrix)
        assert np.linalg.norm(found) <= np.pi + 1e-12
        assert np.allclose(Rotation.from_rotvec(found).as_matrix(), matrix, atol=1e-12)

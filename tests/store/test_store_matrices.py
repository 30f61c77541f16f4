"""Poses and matrices as bytes: their layout, which older maps have on disk, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from raising import raises

from gsmap.errors import InputError
from gsmap.store import matrices
from gsmap.types import Sim3

POSE = Sim3(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1.0, 2, 3]), 0.5)
SYMMETRIC = np.add.outer(np.arange(7.0), np.arange(7.0)) + 100 * np.eye(7)


@pytest.mark.guards("data")
def test_a_pose_is_rotation_translation_and_scale_little_endian() -> None:
    found = np.frombuffer(matrices.pose_bytes(POSE), "<f8")
    assert found.tolist() == [0, -1, 0, 1, 0, 0, 0, 0, 1, 1, 2, 3, 0.5]


@pytest.mark.guards("data")
def test_poses_come_back_in_their_order() -> None:
    other = Sim3(np.eye(3), np.array([7.0, 8, 9]), 2.0)
    first, second = matrices.poses_of_bytes([matrices.pose_bytes(POSE), matrices.pose_bytes(other)])
    for want, found in ((POSE, first), (other, second)):
        np.testing.assert_array_equal(found.matrix(), want.matrix())
        assert found.scale == want.scale
    np.testing.assert_array_equal(matrices.pose_of_bytes(matrices.pose_bytes(other)).matrix(), other.matrix())
    assert matrices.poses_of_bytes([]) == []


@pytest.mark.guards("data")
def test_a_matrix_is_written_row_by_row_and_comes_back() -> None:
    assert np.frombuffer(matrices.matrix_bytes(SYMMETRIC), "<f8").tolist() == SYMMETRIC.ravel().tolist()
    both = matrices.matrices_of_bytes([matrices.matrix_bytes(SYMMETRIC), matrices.matrix_bytes(2 * SYMMETRIC)])
    np.testing.assert_array_equal(both, [SYMMETRIC, 2 * SYMMETRIC])
    assert matrices.matrices_of_bytes([]).shape == (0, 7, 7)


@pytest.mark.guards("data")
def test_a_covariance_is_its_lower_triangle() -> None:
    stored = np.frombuffer(matrices.covariance_bytes(SYMMETRIC), "<f8")
    assert stored.tolist() == [SYMMETRIC[i, j] for i in range(7) for j in range(i + 1)]
    np.testing.assert_array_equal(matrices.covariance_of_bytes(stored.tobytes()), SYMMETRIC)
    both = matrices.covariances_of_bytes([stored.tobytes(), (3 * stored).tobytes()])
    np.testing.assert_array_equal(both, [SYMMETRIC, 3 * SYMMETRIC])


@pytest.mark.guards("data")
@pytest.mark.parametrize("relative", [1e-3, 1e-5])
def test_a_matrix_that_is_not_symmetric_is_refused(relative: float) -> None:
    skewed = SYMMETRIC.copy()
    skewed[6, 0] += relative * np.abs(SYMMETRIC).max()
    for values in ([skewed], [SYMMETRIC, skewed], [skewed, SYMMETRIC], [-skewed]):
        with raises(InputError, code="invalid_record"):
            matrices.matrices_of_bytes([matrices.matrix_bytes(value) for value in values])


@pytest.mark.guards("data")
def test_rounding_is_not_asymmetry() -> None:
    rounded = SYMMETRIC.copy()
    rounded[6, 0] *= 1 + 1e-15
    np.testing.assert_array_equal(matrices.matrix_of_bytes(matrices.matrix_bytes(rounded)), rounded)
    assert not matrices.matrix_of_bytes(bytes(8 * 49)).any()


@pytest.mark.guards("data")
@pytest.mark.parametrize("read", [matrices.pose_of_bytes, matrices.matrix_of_bytes, matrices.covariance_of_bytes])
@pytest.mark.parametrize("num_bytes", [0, 8, 8 * 12, 8 * 14, 8 * 27, 8 * 29, 8 * 48, 8 * 50, 8 * 13 + 1])
def test_bytes_of_another_length_are_refused(read, num_bytes: int) -> None:
    with raises(InputError, code="invalid_record"):
        read(bytes(num_bytes))


@pytest.mark.guards("security")
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_are_refused(value: float) -> None:
    broken = SYMMETRIC.copy()
    broken[3, 3] = value
    with raises(InputError, code="not_finite"):
        matrices.matrix_of_bytes(matrices.matrix_bytes(broken))
    with raises(InputError, code="not_finite"):
        matrices.covariance_of_bytes(matrices.covariance_bytes(broken))
    pose = np.frombuffer(matrices.pose_bytes(POSE), "<f8").copy()
    pose[10] = value
    with raises(InputError, code="not_finite"):
        matrices.pose_of_bytes(pose.tobytes())

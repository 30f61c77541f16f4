"""Convert poses and matrices exactly to bytes or JSON, and back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, overload

import numpy as np

from gsmap.errors import InputError
from gsmap.types import Sim3

_FLOAT = np.dtype("<f8")
_POSE = 13  # rotation row by row, translation, scale
_LOWER = np.tril_indices(7)
_SKEWED = 1e-6  # relative to the largest entry: the solver's tolerance for symmetry


# --- bytes -----------------------------------------------------------------------------------------------------------


def pose_bytes(pose: Sim3) -> bytes:
    """Convert a pose to 13 float64, little-endian: the rotation row by row, the translation, the scale."""
    values = np.empty(_POSE, _FLOAT)
    values[:9], values[9:12], values[12] = pose.rotation.ravel(), pose.translation, pose.scale
    return values.tobytes()


def pose_of_bytes(value: bytes) -> Sim3:
    """Convert bytes to a pose; raises `InputError` for invalid bytes."""
    return poses_of_bytes([value])[0]


def poses_of_bytes(values: Sequence[bytes]) -> list[Sim3]:
    """Convert many poses at once, in a tenth of the time."""
    found = _floats(values, _POSE)
    return Sim3.many(found[:, :9].reshape(-1, 3, 3), found[:, 9:12], found[:, 12])


def matrix_bytes(matrix: np.ndarray) -> bytes:
    """Convert a (7, 7) matrix to 49 float64, little-endian, row by row."""
    return np.ascontiguousarray(np.asarray(matrix, _FLOAT).reshape(7, 7)).tobytes()


def matrix_of_bytes(value: bytes) -> np.ndarray:
    """Convert bytes to a matrix; raises `InputError` unless it is symmetric and finite."""
    found: np.ndarray = matrices_of_bytes([value])[0]
    return found


def matrices_of_bytes(values: Sequence[bytes]) -> np.ndarray:
    """Convert many matrices to (K, 7, 7) float64; see `matrix_of_bytes`."""
    found = _floats(values, 49).reshape(-1, 7, 7).astype(np.float64)
    size = np.abs(found).max((1, 2), initial=0)
    if (np.abs(found - found.transpose(0, 2, 1)).max((1, 2), initial=0) > _SKEWED * size).any():
        raise InputError("the matrix is not symmetric", code="invalid_record")
    return found


def covariance_bytes(covariance: np.ndarray) -> bytes:
    """Convert a symmetric (7, 7) matrix to its lower triangle as 28 float64, little-endian, row by row."""
    return np.asarray(covariance, _FLOAT).reshape(7, 7)[_LOWER].tobytes()


def covariance_of_bytes(value: bytes) -> np.ndarray:
    """Convert bytes to a covariance; raises `InputError` for invalid bytes."""
    found: np.ndarray = covariances_of_bytes([value])[0]
    return found


def covariances_of_bytes(values: Sequence[bytes]) -> np.ndarray:
    """Convert many covariances to (K, 7, 7) float64."""
    lower = _floats(values, len(_LOWER[0]))
    out = np.zeros((len(values), 7, 7))
    out[:, _LOWER[0], _LOWER[1]] = lower
    out[:, _LOWER[1], _LOWER[0]] = lower
    return out


def _floats(values: Sequence[bytes], count: int) -> np.ndarray:
    """Convert bytes to (K, count) finite numbers."""
    if any(len(value) != count * _FLOAT.itemsize for value in values):
        raise InputError(f"the value does not have {count} numbers", code="invalid_record")
    found = np.frombuffer(b"".join(values), _FLOAT).reshape(-1, count)
    if not np.isfinite(found).all():
        raise InputError("NaN or infinity", code="not_finite")
    return found


# --- JSON ------------------------------------------------------------------------------------------------------------


@overload
def from_pose(pose: Sim3) -> dict[str, Any]: ...
@overload
def from_pose(pose: None) -> None: ...
def from_pose(pose: Sim3 | None) -> dict[str, Any] | None:
    if pose is None:
        return None
    return {"rotation": pose.rotation.tolist(), "translation": pose.translation.tolist(), "scale": pose.scale}


@overload
def to_pose(value: dict[str, Any]) -> Sim3: ...
@overload
def to_pose(value: None) -> None: ...
def to_pose(value: dict[str, Any] | None) -> Sim3 | None:
    return None if value is None else Sim3(value["rotation"], value["translation"], value["scale"])


def from_array(array: np.ndarray | None) -> list[Any] | None:
    return None if array is None else np.asarray(array, np.float64).tolist()


@overload
def to_array(value: list[Any]) -> np.ndarray: ...
@overload
def to_array(value: None) -> None: ...
def to_array(value: list[Any] | None) -> np.ndarray | None:
    return None if value is None else np.array(value, np.float64)

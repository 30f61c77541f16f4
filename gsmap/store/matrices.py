"""Poses and matrices as JSON and back, to the last bit."""

from __future__ import annotations

from typing import Any, overload

import numpy as np

from gsmap.types import Sim3


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

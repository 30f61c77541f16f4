"""A scene with its place in the map, whose arrays are read when they are needed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gsmap.types import Cameras, Gaussians, Sim3
from gsmap.types.localization import SceneFeatures


@dataclass(eq=False)
class PlacedFeatures:
    """A scene of the map that photographs may show.

    Args:
        scene: its id.
        S_metric_scene: takes it to the frame of its component, in metres.
        component: which.
        covariance: (7, 7) of that pose, on the scene's side and in its unit, or None.
        read_gaussians, read_features: give its arrays, scene frame and unit.
    """

    scene: str
    S_metric_scene: Sim3
    component: int
    covariance: np.ndarray | None
    read_gaussians: Callable[[], Gaussians]
    read_features: Callable[[], SceneFeatures]

    @cached_property
    def gaussians(self) -> Gaussians:
        return self.read_gaussians()

    @cached_property
    def features(self) -> SceneFeatures:
        return self.read_features()

    def drop(self) -> None:
        """Let go of the arrays."""
        self.__dict__.pop("gaussians", None)
        self.__dict__.pop("features", None)

    def camera(self, T_metric_camera: np.ndarray, intrinsics_px: np.ndarray, size_px: tuple[int, int]) -> Cameras:
        """A camera of the map as one of the scene's frame and unit."""
        S = self.S_metric_scene
        pose = np.eye(4)
        pose[:3, :3] = S.rotation.T @ T_metric_camera[:3, :3]
        pose[:3, 3] = S.inverse().apply(T_metric_camera[:3, 3])
        return Cameras(pose[None], intrinsics_px[None], np.array([size_px]))

"""A scene of the map with its pose; its arrays are read on first use."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from gsmap.geometry.sh import sh0_of_rgb
from gsmap.render.index import ChunkIndex
from gsmap.types import Cameras, Gaussians, Sim3
from gsmap.types.localization import SceneFeatures


@dataclass(eq=False)
class MapScene:
    """A scene in which photos can be localized.

    Args:
        scene: id of the scene.
        S_metric_scene: transform from the scene frame to the frame of its component, in metres.
        component: number of the component.
        covariance: (7, 7) of the scene's pose, on the scene's side and in its unit, or None.
        read_gaussians, read_features: functions that return the arrays, in the scene's frame and unit.
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

    @cached_property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Minimum (3,) and extent (3,) of the Gaussians' means, in the scene's frame."""
        low = self.gaussians.means.min(0).astype(np.float64)
        return low, np.maximum(self.gaussians.means.max(0) - low, 1e-9)

    @cached_property
    def coloured_by_position(self) -> Gaussians:
        """The Gaussians with their means, scaled to the box, as colours: renders of them show positions."""
        low, span = self.box
        sh = sh0_of_rgb((self.gaussians.means - low) / span)[:, None].astype(np.float32)
        return replace(self.gaussians, sh=sh)

    @cached_property
    def index(self) -> ChunkIndex:
        """Boxes of chunks of the Gaussians, by which renders skip those out of view."""
        return ChunkIndex.build(self.gaussians)

    def drop(self) -> None:
        """Release the arrays."""
        for name in ("gaussians", "index", "features", "box", "coloured_by_position"):
            self.__dict__.pop(name, None)

    def camera(self, T_metric_camera: np.ndarray, intrinsics_px: np.ndarray, size_px: tuple[int, int]) -> Cameras:
        """Convert a camera with a pose in the component's frame to a camera in the scene's frame and unit."""
        S = self.S_metric_scene
        pose = np.eye(4)
        pose[:3, :3] = S.rotation.T @ T_metric_camera[:3, :3]
        pose[:3, 3] = S.inverse().apply(T_metric_camera[:3, 3])
        return Cameras(pose[None], intrinsics_px[None], np.array([size_px]))

"""A scene with its place in the map, whose arrays are read when they are needed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from gsmap.geometry.sh import sh0_of_rgb
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

    @cached_property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """(3,) the least coordinates of the Gaussians' middles, scene frame, and (3,) how far they reach from there."""
        low = self.gaussians.means.min(0).astype(np.float64)
        return low, np.maximum(self.gaussians.means.max(0) - low, 1e-9)

    @cached_property
    def coloured_by_place(self) -> Gaussians:
        """The Gaussians, each of the colour that is the place of its middle in their box: a render of these says which
        place a pixel shows."""
        low, span = self.box
        sh = sh0_of_rgb((self.gaussians.means - low) / span)[:, None].astype(np.float32)
        return replace(self.gaussians, sh=sh)

    def drop(self) -> None:
        """Let go of the arrays."""
        for name in ("gaussians", "features", "box", "coloured_by_place"):
            self.__dict__.pop(name, None)

    def camera(self, T_metric_camera: np.ndarray, intrinsics_px: np.ndarray, size_px: tuple[int, int]) -> Cameras:
        """A camera of the map as one of the scene's frame and unit."""
        S = self.S_metric_scene
        pose = np.eye(4)
        pose[:3, :3] = S.rotation.T @ T_metric_camera[:3, :3]
        pose[:3, 3] = S.inverse().apply(T_metric_camera[:3, 3])
        return Cameras(pose[None], intrinsics_px[None], np.array([size_px]))

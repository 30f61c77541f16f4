"""A scene of the map with its pose; its arrays are read on first use."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gsmap.render import Rendering
from gsmap.render.chunked import ChunkedGaussians
from gsmap.types import Cameras, Gaussians, Sim3
from gsmap.types.localization import SceneFeatures
from gsmap.types.source import ChunkSource


@dataclass(eq=False)
class MapScene:
    """A scene in which photos can be localized.

    Args:
        scene: id of the scene.
        S_metric_scene: transform from the scene frame to the frame of its component, in metres.
        component: number of the component.
        covariance: (7, 7) of the scene's pose, on the scene's side and in its unit, or None.
        read_gaussians, read_features: functions that return the arrays, in the scene's frame and unit.
        read_chunks: function that returns the same Gaussians in chunks, of which renders read only the visible ones.
    """

    scene: str
    S_metric_scene: Sim3
    component: int
    covariance: np.ndarray | None
    read_gaussians: Callable[[], Gaussians]
    read_features: Callable[[], SceneFeatures]
    read_chunks: Callable[[], ChunkSource] | None = None

    @cached_property
    def gaussians(self) -> Gaussians:
        return self.read_gaussians()

    @cached_property
    def features(self) -> SceneFeatures:
        return self.read_features()

    @cached_property
    def chunked(self) -> ChunkedGaussians:
        """The Gaussians, of which each chunk is read when it is first seen."""
        if self.read_chunks is None:
            return ChunkedGaussians.of(self.gaussians)
        return ChunkedGaussians(self.read_chunks())

    def render(self, camera: Cameras, *, with_centres: bool = False) -> Rendering:
        """Render colour, alpha and depth of the scene from one camera in its frame, and with ``with_centres`` also
        where the centres of the Gaussians lie."""
        return self.chunked.render(camera, with_centres=with_centres)

    def drop(self) -> None:
        """Release the arrays."""
        for name in ("gaussians", "features", "chunked"):
            self.__dict__.pop(name, None)

    def camera(self, T_metric_camera: np.ndarray, intrinsics_px: np.ndarray, size_px: tuple[int, int]) -> Cameras:
        """Convert a camera with a pose in the component's frame to a camera in the scene's frame and unit."""
        S = self.S_metric_scene
        pose = np.eye(4)
        pose[:3, :3] = S.rotation.T @ T_metric_camera[:3, :3]
        pose[:3, 3] = S.inverse().apply(T_metric_camera[:3, 3])
        return Cameras(pose[None], intrinsics_px[None], np.array([size_px]))

"""A scene of the map with its pose; its arrays are read on first use."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gsmap.render import Rendering, render
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

    def render(self, camera: Cameras) -> Rendering:
        """Render colour, alpha and depth of the scene from one camera in its frame."""
        gaussians, index = self.chunked.seen_from(camera)
        return render(gaussians, camera, dominant_id=False, index=index, backend="native")

    def render_positions(self, camera: Cameras) -> tuple[np.ndarray, np.ndarray]:
        """Render the positions of the Gaussians from one camera in the scene's frame.

        Returns:
            (H, W, 3) positions in the scene's frame, valid where (H, W) alpha is large.
        """
        gaussians, index = self.chunked.coloured_by_position(camera)
        rendered = render(gaussians, camera, depth=False, dominant_id=False, index=index, backend="native")
        low, high = self.chunked.box
        alpha = rendered.alpha[0]
        return rendered.colour[0] / np.maximum(alpha, 1e-3)[..., None] * (high - low) + low, alpha

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

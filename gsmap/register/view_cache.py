"""Render a scene through its own cameras, and select views."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gsmap.geometry.camera_synthesis import synthesise_cameras
from gsmap.geometry.projection import in_image, project, project_all
from gsmap.render import ChunkIndex, render
from gsmap.types import Cameras, Gaussians
from gsmap.types.prepared_scene import PreparedScene

IMAGE_SIZE_PX = 128  # longer side of the renders
_MIN_ALPHA = 0.5  # a fainter pixel shows no surface
_SELECTION_PX = 16  # longer side of the coarse depth images by which cameras are selected
_SELECTION_POINTS = 8_000  # opaque centres that stand for a scene when cameras are selected
# Share of the depth by which a point may lie behind a coarse pixel's depth and still count as visible: half a coarse
# pixel of a slanted wall.
_SELECTION_MARGIN = 0.1
_MIN_OWN_SHARE = 0.8  # of a scene: if its cameras see less, views are synthesized in its free space
_MIN_OWN_HALF = 0.5  # of the visible points: if the scene's own cameras see less, synthesized views are selected, too


@dataclass(frozen=True, eq=False)
class ViewImage:
    """A view of a scene.

    Args:
        colour: (H, W, 3) float32, RGB in [0, 1].
        depth: (H, W) float32 camera-space z in the scene's unit; inf where no surface is seen.
    """

    colour: np.ndarray
    depth: np.ndarray


class ViewCache:
    """Views of a scene by its own cameras and, where these see little of the scene, by synthesized cameras.

    A scene's own cameras may miss the overlap with another scene, or see it from behind a wall, although the Gaussians
    show it. Views do not depend on the pose of a pair, so they serve all pairs of the scene.

    Args:
        gaussians, cameras: Gaussians and cameras in the scene's frame and unit.
        image_size_px: longer side of the views.
        synthesize: add synthesized cameras where the scene's own see too little.
    """

    def __init__(
        self, gaussians: Gaussians, cameras: Cameras, *, image_size_px: int = IMAGE_SIZE_PX, synthesize: bool = True
    ) -> None:
        # The mean colour alone: higher coefficients were fitted to the view directions of the scene's own cameras.
        self._gaussians = gaussians.degree_0()
        self.sample = _sample(gaussians)
        self.cameras = (self._with_synthesized(cameras) if synthesize else cameras).resized(image_size_px)
        self.num_own = 0 if cameras.synthesised else len(cameras)  # synthesized cameras come after these

    def _with_synthesized(self, cameras: Cameras) -> Cameras:
        """Return the scene's cameras, followed by synthesized cameras if they see too little of the scene."""
        if cameras.synthesised or self._share_seen(cameras) >= _MIN_OWN_SHARE:
            return cameras
        synthesized = synthesise_cameras(self._gaussians)
        return Cameras(
            np.concatenate([cameras.T_frame_camera, synthesized.T_frame_camera]),
            np.concatenate([cameras.intrinsics_px, synthesized.intrinsics_px]),
            np.concatenate([cameras.sizes_px, synthesized.sizes_px]),
        )

    def _share_seen(self, cameras: Cameras) -> float:
        """Return the share of the sampled opaque centres that at least one camera sees."""
        coarse = cameras.resized(_SELECTION_PX)
        seen = np.zeros(len(self.sample), bool)
        for at, pixel, z, nearest in self._projected(coarse):
            seen[at[z <= nearest[pixel]]] = True
        return float(seen.mean()) if len(seen) else 1.0

    @cached_property
    def _index(self) -> ChunkIndex:
        return ChunkIndex.build(self._gaussians)

    def image(self, row: int) -> ViewImage:
        """Render the view of one camera."""
        # Always on the CPU, so that verdicts are equal to the bit on every machine; images this small gain nothing on
        # a GPU (docs/how-to/gpu.md).
        seen = render(self._gaussians, self.cameras[[row]], dominant_id=False, index=self._index, backend="native")
        return ViewImage(seen.colour[0], np.where(seen.alpha[0] > _MIN_ALPHA, seen.depth[0], np.float32(np.inf)))

    def select_views(self, points: np.ndarray, count: int) -> list[int]:
        """Select the cameras that see most of some points (N, 3) or of surfaces behind them; see the function
        `select_views`.

        The scene's own cameras are preferred if they see enough: space that they looked through is free, whereas space
        in front of a synthesized camera may be unobserved.
        """
        # Points in front of the empty background of a synthesized view prove nothing.
        synthesized = [np.where(np.isfinite(depth), depth, -np.inf) for depth in self._nearest[self.num_own :]]
        inside = _visible(self._coarse, points, self._nearest[: self.num_own] + synthesized)
        own = inside[: self.num_own]
        if own.any(0).sum() >= _MIN_OWN_HALF * inside.any(0).sum():
            inside = own
        return _greedy(inside, count)

    def select_views_of_sides(self, points: np.ndarray, normals: np.ndarray, count: int) -> list[int]:
        """Select own cameras that together see most sides of a surface given by points and normals (N, 3)."""
        rows = np.linspace(0, len(points) - 1, min(len(points), 1000)).astype(int)
        points, normals = points[rows], normals[rows]
        seen = _visible(self._coarse[: self.num_own], points, self._nearest[: self.num_own])
        towards = self.cameras.T_frame_camera[: self.num_own, None, :3, 3] - points
        front = (towards * normals).sum(2) > 0
        return _greedy(np.concatenate([seen & front, seen & ~front], axis=1), count)

    @cached_property
    def _coarse(self) -> Cameras:
        return self.cameras.resized(_SELECTION_PX)

    @cached_property
    def _nearest(self) -> list[np.ndarray]:
        """Depth of the nearest sampled opaque centre in each coarse pixel of each camera."""
        return [nearest for *_, nearest in self._projected(self._coarse)]

    def _projected(self, coarse: Cameras) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
        """For each camera yield the rows of the sample that lie in its image, their pixels and depths, and the nearest
        depth per pixel."""
        for view, intrinsics, size in zip(coarse.T_camera_frame, coarse.intrinsics_px, coarse.sizes_px, strict=True):
            pixel, z, at = _project(self.sample, view, intrinsics, size)
            nearest = np.full(int(size.prod()), np.inf, np.float32)
            np.minimum.at(nearest, pixel, z)
            yield at, pixel, z, nearest * np.float32(1 + _SELECTION_MARGIN)


class PreparedViews(ViewCache):
    """The views that were rendered when a scene was prepared."""

    def __init__(self, prepared: PreparedScene) -> None:
        self.sample, self.cameras, self.num_own = prepared.sample, prepared.cameras, prepared.num_own
        self._prepared = prepared
        self._starts = np.append(0, np.cumsum(prepared.cameras.sizes_px.prod(1)))

    def image(self, row: int) -> ViewImage:
        """Return the stored view of one camera."""
        width, height = self.cameras.sizes_px[row]
        pixels = slice(self._starts[row], self._starts[row + 1])
        colour = self._prepared.image_colours[pixels].reshape(height, width, 3).astype(np.float32) / 255
        depth = self._prepared.image_depths[pixels].reshape(height, width).astype(np.float32)
        return ViewImage(colour, depth / np.float32(self._prepared.unit_m))


def _sample(gaussians: Gaussians) -> np.ndarray:
    """Return a (S, 3) sample of opaque centres."""
    solid = np.flatnonzero(gaussians.logit_opacities > 0.0)
    rows = np.linspace(0, len(solid) - 1, min(len(solid), _SELECTION_POINTS)).astype(int)
    return gaussians.means[solid[rows]]


def select_views(
    cameras: Cameras, points: np.ndarray, count: int, nearest: list[np.ndarray] | None = None
) -> list[int]:
    """Select greedily the cameras that together see most points.

    Args:
        cameras: the cameras, in the frame of the points.
        points: (N, 3); an even sample of them is tested.
        count: largest number of cameras.
        nearest: flat depth image of each camera; points behind it are occluded.
    """
    return _greedy(_visible(cameras, points, nearest), count)


def _visible(cameras: Cameras, points: np.ndarray, nearest: list[np.ndarray] | None) -> np.ndarray:
    """Return a (C, S) mask that is True if camera c sees point s of an even sample of the points."""
    sample = points[np.linspace(0, len(points) - 1, min(len(points), 1000)).astype(int)].astype(np.float32)
    column, row, z = project_all(sample, cameras.T_camera_frame, cameras.intrinsics_px)
    width, height = cameras.sizes_px.T[..., None]
    with np.errstate(invalid="ignore"):
        inside: np.ndarray = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    for c, depth in enumerate(nearest or ()):
        at = np.flatnonzero(inside[c])
        pixel = row[c, at].astype(np.int64) * int(width[c, 0]) + column[c, at].astype(np.int64)
        inside[c, at] = z[c, at] <= depth[pixel]
    return inside


def _greedy(inside: np.ndarray, count: int) -> list[int]:
    """Select greedily the rows that together cover most columns."""
    left = np.ones(inside.shape[1], dtype=bool)
    chosen: list[int] = []
    for _ in range(min(count, len(inside))):
        gain = (inside & left).sum(1)
        best = int(gain.argmax())
        if not gain[best]:
            break
        chosen.append(best)
        left &= ~inside[best]
    return chosen


def _project(
    points: np.ndarray, view: np.ndarray, intrinsics_px: np.ndarray, size_px: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return flat pixel indices, depths and rows of those points (float32) that project into an image."""
    pixels, depth = project(points, view, intrinsics_px)
    rows = np.flatnonzero(in_image(pixels, depth, size_px))
    column, row = np.floor(pixels[rows]).astype(np.int64).T
    return row * int(size_px[0]) + column, depth[rows], rows

"""Test spatial overlap of scenes in the map frame, and concatenate scenes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmap.geometry.boxes import box_around
from gsmap.geometry.projection import in_image, project
from gsmap.types import Cameras, Gaussians, PosedScene


def clamp_inside(points: np.ndarray, bounds: np.ndarray | None) -> np.ndarray:
    """Clamp float32 points (N, 3) to half-open bounds, so that `gsmap.geometry.boxes.inside` accepts them."""
    if bounds is None:
        return points
    low, high = bounds.astype(np.float32)
    low = np.where(low < bounds[0], np.nextafter(low, np.float32(np.inf)), low)
    high = np.where(high >= bounds[1], np.nextafter(high, np.float32(-np.inf)), high)
    return np.clip(points, low, high)


def concatenate_scenes(scenes: Sequence[PosedScene]) -> tuple[Gaussians, np.ndarray]:
    """Concatenate the Gaussians of scenes, and return the (N,) int32 scene index of each Gaussian."""
    origin = np.repeat(np.arange(len(scenes), dtype=np.int32), [len(s.gaussians) for s in scenes])
    return Gaussians.concatenate([s.gaussians for s in scenes]), origin


def boxes_overlap(a: PosedScene, b: PosedScene) -> bool:
    """Return whether the bounding boxes of two scenes' means intersect."""
    if len(a.gaussians) == 0 or len(b.gaussians) == 0:
        return False
    (a_low, a_high), (b_low, b_high) = (box_around(scene.gaussians.means) for scene in (a, b))
    return bool((np.maximum(a_low, b_low) <= np.minimum(a_high, b_high)).all())


def share_in_view(cameras: Cameras, points: np.ndarray, sample: int = 2000) -> np.ndarray:
    """Return the (C,) fraction of points (N, 3), sampled evenly, in the frustum of each camera."""
    points = points[:: max(1, len(points) // sample)].astype(np.float64)
    share = np.zeros(len(cameras))
    if len(points):
        for c, T_camera_frame in enumerate(cameras.T_camera_frame):
            pixels, depth = project(points, T_camera_frame, cameras.intrinsics_px[c])
            share[c] = in_image(pixels, depth, cameras.sizes_px[c]).mean()
    return share

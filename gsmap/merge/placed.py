"""Placed scenes and boxes: what lies in a tile, what overlaps, what is in view."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmap.geometry.boxes import box_around
from gsmap.geometry.projection import in_image, project
from gsmap.types import Cameras, Gaussians, PlacedScene


def pulled_inside(points: np.ndarray, bounds: np.ndarray | None) -> np.ndarray:
    """Float32 points (N, 3) moved to the nearest place that `inside` calls inside."""
    if bounds is None:
        return points
    low, high = bounds.astype(np.float32)
    low = np.where(low < bounds[0], np.nextafter(low, np.float32(np.inf)), low)
    high = np.where(high >= bounds[1], np.nextafter(high, np.float32(-np.inf)), high)
    return np.clip(points, low, high)


def united(scenes: Sequence[PlacedScene]) -> tuple[Gaussians, np.ndarray]:
    """All Gaussians of the scenes in order, and the index (N,) int32 of the scene of each."""
    origin = np.repeat(np.arange(len(scenes), dtype=np.int32), [len(s.gaussians) for s in scenes])
    return Gaussians.concatenate([s.gaussians for s in scenes]), origin


def overlapping(a: PlacedScene, b: PlacedScene) -> bool:
    """Whether the boxes around two scenes' means meet: cheap, and spares comparing captures of different places."""
    if len(a.gaussians) == 0 or len(b.gaussians) == 0:
        return False
    (a_low, a_high), (b_low, b_high) = (box_around(scene.gaussians.means) for scene in (a, b))
    return bool((np.maximum(a_low, b_low) <= np.minimum(a_high, b_high)).all())


def share_in_view(cameras: Cameras, points: np.ndarray, sample: int = 2000) -> np.ndarray:
    """(C,) share of points (N, 3) that lie in front of each camera and in its picture, from an even sample of them."""
    points = points[:: max(1, len(points) // sample)].astype(np.float64)
    share = np.zeros(len(cameras))
    if len(points):
        for c, T_camera_frame in enumerate(cameras.T_camera_frame):
            pixels, depth = project(points, T_camera_frame, cameras.intrinsics_px[c])
            share[c] = in_image(pixels, depth, cameras.sizes_px[c]).mean()
    return share

"""What the sampled cameras of a capture see."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from gsmap.render import render
from gsmap.types import Cameras, Gaussians


@dataclass(frozen=True, eq=False)
class View:
    """One render.

    Args:
        rgb: (H, W, 3) uint8.
        depth: (H, W) float32, scene units, 0 where nothing was drawn.
        alpha: (H, W) float32.
        dominant_id: (H, W) int32 row of the Gaussian that weighs most, -1 where nothing was drawn.
        camera: `Cameras` of length 1, of the render's size.
    """

    rgb: np.ndarray
    depth: np.ndarray
    alpha: np.ndarray
    dominant_id: np.ndarray
    camera: Cameras


def sample_cameras(cameras: Cameras, count: int) -> Cameras:
    """``count`` cameras evenly spread over the capture, in its order; all where there are fewer."""
    if len(cameras) <= count:
        return cameras
    return cameras[np.linspace(0, len(cameras) - 1, count).round().astype(int)]


def render_views(gaussians: Gaussians, cameras: Cameras, longest_side_px: int) -> Iterator[View]:
    """Yield a view per camera, each at its own aspect ratio."""
    small = cameras.resized(longest_side_px)
    for i in range(len(small)):
        camera = small[i]
        image = render(gaussians, camera)
        rgb = (np.clip(np.nan_to_num(image.colour[0]), 0, 1) * 255 + 0.5).astype(np.uint8)
        yield View(rgb, image.depth[0], image.alpha[0], image.dominant_id[0], camera)


def is_blocked(view: View, nearest: float) -> bool:
    """Whether the camera stands inside something: most of its picture is closer than ``nearest``, or empty."""
    seen = view.alpha > 0.5
    return bool(seen.mean() < 0.2 or (view.depth[seen] < nearest).mean() > 0.5)

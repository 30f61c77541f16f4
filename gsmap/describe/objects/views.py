"""Render views of a capture from a sample of its cameras."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gsmap.render import ChunkIndex, render
from gsmap.types import Cameras, Gaussians
from gsmap.types.views import View

_MIN_SEEN = 0.2  # a view with a smaller share of covered pixels counts as empty


def render_views(gaussians: Gaussians, cameras: Cameras, longest_side_px: int, backend: str = "auto") -> Iterator[View]:
    """Yield a view for each camera, at the camera's own aspect ratio.

    Args:
        gaussians, cameras: Gaussians and cameras in one frame.
        backend: see `gsmap.render.render`.
    """
    small = cameras.resized(longest_side_px)
    index = ChunkIndex.build(gaussians)  # a camera sees a room or two of a large capture
    for i in range(len(small)):
        camera = small[i]
        image = render(gaussians, camera, backend=backend, index=index)
        rgb = (np.clip(np.nan_to_num(image.colour[0]), 0, 1) * 255 + 0.5).astype(np.uint8)
        yield View(rgb, image.depth[0], image.alpha[0], image.dominant_id[0], camera)


def is_blocked(view: View, nearest: float) -> bool:
    """Return whether the camera is inside an object: its view is mostly nearer than ``nearest``, or empty.

    Args:
        nearest: distance in scene units.
    """
    seen = view.alpha > 0.5
    return bool(seen.mean() < _MIN_SEEN or (view.depth[seen] < nearest).mean() > 0.5)

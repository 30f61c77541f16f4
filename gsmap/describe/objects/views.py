"""Rendered views of a capture from its sampled cameras."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gsmap.render import ChunkIndex, render
from gsmap.types import Cameras, Gaussians
from gsmap.types.views import View

_MIN_SEEN = 0.2  # a view of which a smaller share shows anything is empty


def render_views(gaussians: Gaussians, cameras: Cameras, longest_side_px: int, backend: str = "auto") -> Iterator[View]:
    """Yield a view per camera, each at its own aspect ratio.

    Args:
        gaussians, cameras: of one frame.
        backend: as for `gsmap.render.render`.
    """
    small = cameras.resized(longest_side_px)
    index = ChunkIndex.build(gaussians)  # a camera sees a room or two of a large capture
    for i in range(len(small)):
        camera = small[i]
        image = render(gaussians, camera, backend=backend, index=index)
        rgb = (np.clip(np.nan_to_num(image.colour[0]), 0, 1) * 255 + 0.5).astype(np.uint8)
        yield View(rgb, image.depth[0], image.alpha[0], image.dominant_id[0], camera)


def is_blocked(view: View, nearest: float) -> bool:
    """Return True if the camera is inside an object: most of its view is nearer than ``nearest``, or empty.

    Args:
        nearest: scene units.
    """
    seen = view.alpha > 0.5
    return bool(seen.mean() < _MIN_SEEN or (view.depth[seen] < nearest).mean() > 0.5)

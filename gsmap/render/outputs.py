"""Images of a rendering, and their common size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from gsmap.errors import InputError
from gsmap.types import Cameras


@dataclass(frozen=True, eq=False)
class Rendering:
    """Images of C cameras, as numpy arrays or torch tensors, like the Gaussians.

    Args:
        colour: (C, H, W, 3) float32, not clamped above.
        alpha: (C, H, W) float32 in [0, 1].
        depth: (C, H, W) float32 expected camera-space z, ``sum w z / sum w``, 0 where alpha is 0; or None.
        dominant_id: (C, H, W) int32 Gaussian with the largest blending weight, -1 where nothing was drawn; or None.
        max_weight: (N,) float32 largest blending weight of each Gaussian over all pixels of all views; or None.
        centre: (C, H, W, 2) float32 mean image position, by blending weight, of the Gaussians' centres; or None.
    """

    colour: Any
    alpha: Any
    depth: Any = None
    dominant_id: Any = None
    max_weight: Any = None
    centre: Any = None


def image_size(cameras: Cameras) -> tuple[int, int]:
    """Return the ``(width, height)`` that all cameras have in common.

    Raises:
        InputError: the argument is not `Cameras`, sizes differ, or an image is larger than the 65,535 tiles of 32
            pixels that the rasterizer allows on a side.
    """
    if not isinstance(cameras, Cameras):
        raise InputError(f"render needs gsmap.types.Cameras, got {type(cameras).__name__}", code="wrong_type")
    if len(cameras) == 0:
        return 1, 1
    width, height = (int(v) for v in cameras.sizes_px[0])
    if (cameras.sizes_px != (width, height)).any():
        sizes = sorted({f"{w}x{h}" for w, h in cameras.sizes_px.tolist()})
        raise InputError(
            f"cameras of one render call must share one image size, got {', '.join(sizes[:5])}", code="shape_mismatch"
        )
    if width * height > 2**28:
        raise InputError(
            f"an image of {width}x{height} pixels is too large to render: resize the cameras", code="picture_too_large"
        )
    return width, height

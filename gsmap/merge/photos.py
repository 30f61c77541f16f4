"""Photographs that a map keeps, as pictures that the merged map must look like.

A photograph is sharper than any splat. But it has its own exposure, and may show what the capture that it was found in
does not: people, a chair that was moved, another season. So it is brought to the colours of that capture, and counts
where it shows the same.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsmap.compare import colours
from gsmap.compare.neighbourhoods import grown
from gsmap.errors import ConfigError
from gsmap.render import render
from gsmap.types import Cameras, KeptPhoto, PlacedScene


@dataclass(frozen=True)
class Params:
    """Which photographs are reproduced, and how often.

    Args:
        share: how often one is used in every pass over all views, as often as so many views that a capture renders; 0
            leaves all of them out.
        max_photos: at most; those in which most of the tile lies.
        max_sigma_px: one whose pose is known less well than so many pixels, at a picture of 480, is left out.
        min_alpha: a pixel counts where the capture is as opaque ...
        min_agreeing: ... and a photograph where it shows so large a share of what the capture shows there.
        margin_px: what is so near to a pixel that differs does not count either.
        max_spread: colours of a photograph and of a capture that show the same spread no more than so about the line
            between them (standard deviation, of [0, 1]) ...
        min_slope: ... and it rises by this at least: of what shows nothing the same it follows nothing.
    """

    share: float = 4.0
    max_photos: int = 120
    max_sigma_px: float = 3.0
    min_alpha: float = 0.9
    min_agreeing: float = 0.4
    margin_px: int = 2
    max_spread: float = 0.03
    min_slope: float = 0.5

    def __post_init__(self) -> None:
        for name in ("share", "max_photos", "max_sigma_px", "margin_px", "max_spread"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"{name} must not be negative, got {getattr(self, name)}")


@dataclass(frozen=True, eq=False)
class Shown:
    """A photograph that is to be reproduced.

    Args:
        camera: one, map frame.
        image: (H, W, 3) uint8 in the colours of the capture.
        counts: (H, W) bool, where it shows what that shows.
        depth: (H, W) float32 of that, 0 where there is none.
    """

    camera: Cameras
    image: np.ndarray
    counts: np.ndarray
    depth: np.ndarray


def shown(photo: KeptPhoto, scene: PlacedScene, longest_side_px: int, params: Params) -> Shown | None:
    """A photograph beside what its capture shows from there; None where that is something else, or its pose is not
    known well enough."""
    longest = int(photo.camera.sizes_px.max())
    camera = photo.camera.resized(min(longest_side_px, longest))
    seen = render(scene.gaussians if photo.around is None else photo.around(), camera, dominant_id=False)
    opaque = (seen.alpha[0] > params.min_alpha) & (seen.depth[0] > 0)
    if not opaque.any():
        return None
    focal = float(camera.intrinsics_px[0, 0]) * 480 / camera.sizes_px.max()
    sigma_px = focal * np.hypot(photo.sigma_rad, photo.sigma_m / float(np.median(seen.depth[0][opaque])))
    if sigma_px > params.max_sigma_px:
        return None
    picture = _resized(photo.read(), camera)
    line = colours.balance(picture[opaque], seen.colour[0][opaque])
    if line.slope.min() < params.min_slope:
        return None
    line = replace(
        line,
        chroma_spread=min(line.chroma_spread, params.max_spread),
        lightness_spread=min(line.lightness_spread, params.max_spread),
    )
    differ = colours.differ(line, *line.differences(picture, seen.colour[0], opaque))
    counts = opaque & ~grown(differ & opaque, params.margin_px)
    if counts.sum() < params.min_agreeing * opaque.sum():
        return None
    image = np.round(line.applied(picture) * 255).astype(np.uint8)
    return Shown(camera, image, counts, seen.depth[0])


def _resized(picture: np.ndarray, camera: Cameras) -> np.ndarray:
    """(H, W, 3) float32 in [0, 1] of a camera's size."""
    from PIL import Image

    width, height = (int(side) for side in camera.sizes_px[0])
    if picture.shape[:2] != (height, width):
        picture = np.asarray(Image.fromarray(picture).resize((width, height), Image.Resampling.BOX, reducing_gap=3.0))
    return picture.astype(np.float32) / 255

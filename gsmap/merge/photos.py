"""Kept photos as reference views of merging.

A photo is sharper than a render, but has its own exposure, and may show people, moved objects or another season than
the scene in which it was localized. So the photo is balanced to the colours of that scene, and counts only where both
agree.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsmap.compare import colours
from gsmap.compare.neighbourhoods import dilate
from gsmap.render import render
from gsmap.types import Cameras, PosedScene, ReferencePhoto

_MAX_SIGMA_PX = 3.0  # largest pose uncertainty of a photo that is used, at a longest side of 480 pixels
_MIN_ALPHA = 0.9  # smallest alpha of the scene in pixels that are compared
_MIN_AGREEMENT = 0.4  # smallest fraction of these pixels that must agree
_MARGIN_PX = 2  # margin around pixels that differ, which is ignored as well
_MAX_SPREAD = 0.03  # largest standard deviation, of colours in [0, 1], about the line from photo to scene
_MIN_SLOPE = 0.5  # smallest slope of that line: colours of a photo of another place are unrelated


@dataclass(frozen=True, eq=False)
class PhotoReference:
    """A photo as a reference view.

    Args:
        camera: one camera in the map frame.
        image: (H, W, 3) uint8 image, balanced to the colours of the scene.
        counts: (H, W) mask of pixels that agree with the scene.
        depth: (H, W) float32 depth of the scene, 0 without a surface.
    """

    camera: Cameras
    image: np.ndarray
    counts: np.ndarray
    depth: np.ndarray


def make_photo_reference(photo: ReferencePhoto, scene: PosedScene, longest_side_px: int) -> PhotoReference | None:
    """Balance a photo to its scene and mask pixels that disagree; return None if it shows another place or its pose is
    uncertain."""
    longest = int(photo.camera.sizes_px.max())
    camera = photo.camera.resized(min(longest_side_px, longest))
    seen = render(scene.gaussians if photo.around is None else photo.around(), camera, dominant_id=False)
    opaque = (seen.alpha[0] > _MIN_ALPHA) & (seen.depth[0] > 0)
    if not opaque.any():
        return None
    focal = float(camera.intrinsics_px[0, 0]) * 480 / camera.sizes_px.max()
    sigma_px = focal * np.hypot(photo.sigma_rad, photo.sigma_m / float(np.median(seen.depth[0][opaque])))
    if sigma_px > _MAX_SIGMA_PX:
        return None
    picture = _resized(photo.read(), camera)
    line = colours.balance(picture[opaque], seen.colour[0][opaque])
    if line.slope.min() < _MIN_SLOPE:
        return None
    line = replace(
        line,
        chroma_spread=min(line.chroma_spread, _MAX_SPREAD),
        lightness_spread=min(line.lightness_spread, _MAX_SPREAD),
    )
    differing = colours.colours_differ(line, *line.differences(picture, seen.colour[0], opaque))
    counts = opaque & ~dilate(differing & opaque, _MARGIN_PX)
    if counts.sum() < _MIN_AGREEMENT * opaque.sum():
        return None
    image = np.round(line.applied(picture) * 255).astype(np.uint8)
    return PhotoReference(camera, image, counts, seen.depth[0])


def _resized(picture: np.ndarray, camera: Cameras) -> np.ndarray:
    """Resize an image to the size of a camera; return (H, W, 3) float32 in [0, 1]."""
    from PIL import Image

    width, height = (int(side) for side in camera.sizes_px[0])
    if picture.shape[:2] != (height, width):
        picture = np.asarray(Image.fromarray(picture).resize((width, height), Image.Resampling.BOX, reducing_gap=3.0))
    return picture.astype(np.float32) / 255

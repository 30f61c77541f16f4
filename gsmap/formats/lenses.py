"""Approximate cameras of other models by pinholes, and measure the error at the corners of the image.

Splats are trained on undistorted images, and gsmap's cameras are pinholes. A camera file may hold the cameras of the
distorted images all the same: its poses are right, and its rays are not those of the pinhole.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from gsmap.errors import NotPinholesError

# Of half the diagonal. Beyond it a third of what the photo shows lies outside the pinhole's view, or the reverse.
_MAX_SHIFT = 0.25
_MIN_SHIFT_PX = 0.01
_ROUND_TRIP_PX = 0.5

_UNDISTORT = (
    "undistort the images (colmap image_undistorter), or split panoramas into pinhole views, and give their cameras"
)


@dataclass(frozen=True)
class Lens:
    """The pinhole that approximates a camera of some model, with the focal lengths and principal point of that camera.

    Args:
        model: Name of the model in COLMAP or nerfstudio.
        size_px: Width and height of the image.
        intrinsics_px: ``fx fy cx cy`` of the pinhole; zeros where the model has none.
        shift_px: Largest distance at a corner of the image between a pixel and the pinhole's projection of its ray;
            infinite where a corner has no ray in front of the camera.
    """

    model: str
    size_px: tuple[int, int]
    intrinsics_px: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    shift_px: float = math.inf

    @property
    def is_pinhole(self) -> bool:
        """True if a pinhole camera can approximate the lens."""
        return self.shift_px <= _MAX_SHIFT * math.hypot(*self.size_px) / 2


@lru_cache(maxsize=4096)
def lens_of(model: object, width: int, height: int, params: tuple[float, ...]) -> Lens:
    """Return the lens of a COLMAP camera model and its parameters.

    Args:
        model: Name of the model, or its `pycolmap.CameraModelId`.
        params: Parameters in COLMAP's order.

    Raises:
        ValueError, RuntimeError: Unknown model, or a wrong number of parameters.
    """
    import pycolmap

    camera = pycolmap.Camera(model=model, width=width, height=height, params=list(params))
    if not camera.verify_params():
        raise ValueError(f"{len(params)} parameters do not fit the camera model {camera.model_name}")
    if not camera.focal_length_idxs():  # asking such a camera for its focal length ends the process
        return Lens(camera.model_name, (width, height))
    fx, fy, cx, cy = (
        camera.focal_length_x,
        camera.focal_length_y,
        camera.principal_point_x,
        camera.principal_point_y,
    )
    intrinsics = (fx, fy, cx, cy)
    if camera.model_name in ("PINHOLE", "SIMPLE_PINHOLE"):
        return Lens(camera.model_name, (width, height), intrinsics, 0.0)
    corners = np.array([[0, 0], [width, 0], [0, height], [width, height]], np.float64)
    with np.errstate(all="ignore"):
        rays = np.asarray(camera.cam_ray_from_img(corners), np.float64)
        # Beyond the angles that a model holds, pycolmap returns rays of other pixels.
        back = np.asarray(camera.img_from_cam(rays), np.float64)
        is_ray = (np.linalg.norm(back - corners, axis=1) < _ROUND_TRIP_PX) & (rays[:, 2] > 0)
        pixels = rays[:, :2] / rays[:, 2:] * [fx, fy] + [cx, cy]
        shift = float(np.linalg.norm(pixels - corners, axis=1).max()) if is_ray.all() else math.inf
    return Lens(camera.model_name, (width, height), intrinsics, shift)


def keep_pinholes(lenses: Sequence[Lens], where: object) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return a mask (C,) that is True for cameras that a pinhole can approximate, and notes on all lenses.

    Args:
        where: File or folder of the cameras, for messages.

    Raises:
        NotPinholesError: No camera can be approximated by a pinhole.
    """
    kept = np.array([lens.is_pinhole for lens in lenses], bool)
    notes = []
    for model in sorted({lens.model for lens in lenses}):
        rough = [a.shift_px for a in lenses if a.model == model and a.is_pinhole and a.shift_px > _MIN_SHIFT_PX]
        if rough:
            notes.append(
                f"{len(rough)} of {len(lenses)} cameras have distortion ({model}) and are read as pinholes, which is "
                f"off by up to {max(rough):.3g} px at the corners of the images: where that matters, {_UNDISTORT}"
            )
        left_out = sum(lens.model == model and not lens.is_pinhole for lens in lenses)
        if left_out:
            notes.append(
                f"{left_out} of {len(lenses)} cameras are left out, for no pinhole stands for their lens ({model}): "
                f"{_UNDISTORT}"
            )
    if len(lenses) and not kept.any():
        raise NotPinholesError(f"{where}: {'; '.join(notes)}")
    return kept, tuple(notes)

"""Data of a single scene that all its registrations share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.errors import InputError
from gsmap.types.cameras import Cameras


@dataclass(frozen=True, eq=False)
class PreparedScene:
    """Surface cells and renders of one scene, which do not depend on the other scene of a pair.

    Args:
        scene: id of the scene.
        unit_m: working metres per unit of the scene.
        centre: (3,) float64 median of the centres of all Gaussians, in the scene's frame and unit.
        is_surface: (N,) bool mask of the Gaussians on surfaces; the rest are transparent, huge or floaters.
        points: (M, 3) float32 mean positions of surface cells, in working metres.
        colours: (M, 3) float16 mean view-independent colours of the cells, RGB in [0, 1].
        normals: (M, 3) float32 unit normals of the cells, of arbitrary sign.
        sides: (M,) int8; 1 if cameras saw the side to which the normal points, -1 for the other side, 0 if unknown.
        sample: (S, 3) float32 centres of opaque Gaussians, in the scene's frame and unit, by which views are selected.
        cameras: V cameras of the views, in the scene's frame and unit: own cameras, then synthesized cameras.
        num_own: number of own cameras.
        image_colours: (P, 3) uint8 colours of the pixels of all views, one view after the other, row by row.
        image_depths: (P,) float16 depths of these pixels in working metres; inf where no surface is seen.
    """

    scene: str
    unit_m: float
    centre: np.ndarray
    is_surface: np.ndarray
    points: np.ndarray
    colours: np.ndarray
    normals: np.ndarray
    sides: np.ndarray
    sample: np.ndarray
    cameras: Cameras
    num_own: int
    image_colours: np.ndarray
    image_depths: np.ndarray

    def __post_init__(self) -> None:
        cells, pixels = len(self.points), int(self.cameras.sizes_px.prod(1).sum())
        shapes = {
            "centre": (3,),
            "points": (cells, 3),
            "colours": (cells, 3),
            "normals": (cells, 3),
            "sides": (cells,),
            "image_colours": (pixels, 3),
            "image_depths": (pixels,),
        }
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise InputError(
                    f"PreparedScene.{name} must have shape {shape}, got {getattr(self, name).shape}",
                    code="shape_mismatch",
                )
        if not (np.isfinite(self.unit_m) and self.unit_m > 0 and 0 <= self.num_own <= len(self.cameras)):
            raise InputError(
                f"PreparedScene has an invalid unit of {self.unit_m} m or number of own cameras {self.num_own}",
                code="invalid_record",
            )

    @property
    def num_bytes(self) -> int:
        """Return the size in memory, without cameras."""
        return sum(value.nbytes for value in vars(self).values() if isinstance(value, np.ndarray))

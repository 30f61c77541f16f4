"""Photographs, what a scene shows of itself to find them by, and where they were taken."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from gsmap.errors import InputError
from gsmap.types.cameras import Cameras


@dataclass(frozen=True, eq=False)
class Photo:
    """A photograph, and what is known of the lens that took it.

    Args:
        rgb: (H, W, 3) uint8, upright as it was taken, undistorted.
        intrinsics_px: (4,) ``fx fy cx cy``, in its pixels: as given, or the best guess.
        focal_sigma: by which share the focal length may be off (one standard deviation): 0 where it is known, inf
            where nothing is.
        name: to speak of it.
        known: (H, W) bool: pixels that show the place, and not who or what stood before it; None where all may.

    Raises:
        InputError: no picture, or intrinsics or a mask that cannot be.
    """

    rgb: np.ndarray
    intrinsics_px: np.ndarray
    focal_sigma: float = 0.0
    name: str = "photo"
    known: np.ndarray | None = None

    def __post_init__(self) -> None:
        intrinsics = np.array(self.intrinsics_px, dtype=np.float64)
        if self.rgb.ndim != 3 or self.rgb.shape[2] != 3 or self.rgb.dtype != np.uint8 or min(self.rgb.shape) < 1:
            raise InputError(
                f"{self.name}: a photo is (H, W, 3) uint8, got {self.rgb.shape} {self.rgb.dtype}", code="shape_mismatch"
            )
        if intrinsics.shape != (4,) or not np.isfinite(intrinsics).all() or (intrinsics[:2] <= 0).any():
            raise InputError(
                f"{self.name}: intrinsics are fx,fy,cx,cy in pixels, focal lengths above 0", code="invalid_intrinsics"
            )
        if self.known is not None and (self.known.shape != self.rgb.shape[:2] or self.known.dtype != bool):
            told = f"{self.known.shape} {self.known.dtype}"
            raise InputError(
                f"{self.name}: a mask is {self.rgb.shape[:2]} bool, as its photo, got {told}", code="shape_mismatch"
            )
        object.__setattr__(self, "intrinsics_px", intrinsics)

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        return self.rgb.shape[1], self.rgb.shape[0]


@dataclass(frozen=True, eq=False)
class Keypoints:
    """What an extractor finds in one picture.

    Args:
        pixels: (N, 2) float32 ``column row``; the first pixel's centre is 0.5 0.5.
        descriptors: (N, D) float32 unit vectors.
        angles_rad: (N,) float32 by which each was turned before it was described; None of an extractor that turns none.
        sizes_px: (N,) float32 how large each is (standard deviation of the blur that it was found in); None of an
            extractor that does not say.
    """

    pixels: np.ndarray
    descriptors: np.ndarray
    angles_rad: np.ndarray | None = None
    sizes_px: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.pixels)


@dataclass(frozen=True, eq=False)
class SceneFeatures:
    """What views of a scene show of it: local features with their places.

    Args:
        scene: its id.
        cameras: V that the views were rendered from, scene frame and unit.
        starts: (V + 1,) int64 where the features of each view begin.
        points: (N, 3) float32 places of the features, scene frame and unit.
        descriptors: (N, D) int8 of unit vectors (`gsmap.localize.quantised`).
        angles: (N,) uint8 by which each was turned before it was described, 256 to a full turn; zeros where none was.
    """

    scene: str
    cameras: Cameras
    starts: np.ndarray
    points: np.ndarray
    descriptors: np.ndarray
    angles: np.ndarray

    @property
    def num_views(self) -> int:
        return len(self.cameras)

    @property
    def num_features(self) -> int:
        return len(self.points)


@dataclass(frozen=True, eq=False)
class Placement:
    """Where a photograph was taken, or why that is not said.

    Args:
        name: of the photo.
        reason: why it is refused; empty where it is placed.
        T_map_camera: (4, 4) camera-to-map in the frame and unit of its component (OpenCV axes); None where refused.
        covariance: (6, 6) over [rot_rad (3), trans (3)] on the camera's side, ``T = T_hat Exp(xi)``, map unit.
        component: whose frame that is.
        scenes: ids of those that support it, who supports most first.
        intrinsics_px: (4,) of the photo's own size, as they were solved where they were not known.
        probability: that it is right, of all evidence together; 0 where there was nothing to judge.
        evidence: numbers behind that, by name.
        num_gaussians: of the supporting scenes, that the photo's camera sees.
    """

    name: str
    reason: str
    T_map_camera: np.ndarray | None = None
    covariance: np.ndarray | None = None
    component: int | None = None
    scenes: tuple[str, ...] = ()
    intrinsics_px: np.ndarray | None = None
    probability: float = 0.0
    evidence: Mapping[str, float] = field(default_factory=dict)
    num_gaussians: int = 0

    @property
    def is_placed(self) -> bool:
        return not self.reason

"""Photos, view features, and the results of localization."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from gsmap.errors import InputError
from gsmap.reason_codes import reason_code
from gsmap.types.cameras import Cameras


@dataclass(frozen=True, eq=False)
class Photo:
    """A photo with its intrinsics and mask.

    Args:
        rgb: (H, W, 3) uint8, upright, undistorted.
        intrinsics_px: (4,) ``fx fy cx cy`` in its pixels, specified or guessed.
        focal_sigma: relative standard deviation of the focal length: 0 if it is known, inf if unknown.
        name: name for messages.
        known: (H, W) bool mask of pixels that show the place and not a person or object in front; None for all.
        lens: name of the camera model that was undone; empty for a pinhole.
        faces: photos of 90 degrees that a panorama or a wide fisheye photo consists of, each with ``R_photo_face``
            (3, 3); it is localized by these, and has no intrinsics of its own.

    Raises:
        InputError: no picture, or intrinsics or a mask that cannot be.
    """

    rgb: np.ndarray
    intrinsics_px: np.ndarray
    focal_sigma: float = 0.0
    name: str = "photo"
    known: np.ndarray | None = None
    lens: str = ""
    faces: tuple[tuple[Photo, np.ndarray], ...] = ()

    def __post_init__(self) -> None:
        intrinsics = np.array(self.intrinsics_px, dtype=np.float64)
        if self.rgb.ndim != 3 or self.rgb.shape[2] != 3 or self.rgb.dtype != np.uint8 or min(self.rgb.shape) < 1:
            raise InputError(
                f"{self.name}: a photo must be a (H, W, 3) uint8 array, got {self.rgb.shape} {self.rgb.dtype}",
                code="shape_mismatch",
            )
        if intrinsics.shape != (4,) or not np.isfinite(intrinsics).all() or (intrinsics[:2] <= 0).any():
            raise InputError(
                f"{self.name}: intrinsics must be fx,fy,cx,cy in pixels, with positive focal lengths",
                code="invalid_intrinsics",
            )
        if self.known is not None and (self.known.shape != self.rgb.shape[:2] or self.known.dtype != bool):
            told = f"{self.known.shape} {self.known.dtype}"
            raise InputError(
                f"{self.name}: a mask must be bool of the shape {self.rgb.shape[:2]} of its photo, got {told}",
                code="shape_mismatch",
            )
        object.__setattr__(self, "intrinsics_px", intrinsics)

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        return self.rgb.shape[1], self.rgb.shape[0]


@dataclass(frozen=True, eq=False)
class Keypoints:
    """The keypoints of one image.

    Args:
        pixels: (N, 2) float32 ``column row``; the first pixel's centre is 0.5 0.5.
        descriptors: (N, D) float32 unit vectors.
        angles_rad: (N,) float32 orientation of each keypoint; None for an extractor without orientations.
        sizes_px: (N,) float32 scale of each keypoint (standard deviation of its blur); None for an extractor without
            scales.
    """

    pixels: np.ndarray
    descriptors: np.ndarray
    angles_rad: np.ndarray | None = None
    sizes_px: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.pixels)


@dataclass(frozen=True, eq=False)
class SceneFeatures:
    """Local features of a scene's views with their 3D points.

    Args:
        scene: scene id.
        cameras: V cameras of the rendered views, scene frame and unit.
        starts: (V + 1,) int64 start of each view's features.
        points: (N, 3) float32 points of the features, scene frame and unit.
        descriptors: (N, D) int8 quantized unit vectors (`gsmap.localize.features.quantize`).
        angles: (N,) uint8 orientation, 256 per full turn; zeros without orientations.
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
class Localization:
    """The pose of a photo or scan in the map, or the reason for refusing it.

    Args:
        reason: reason for the refusal; empty if it is placed.
        T_map_camera: (4, 4) camera-to-map of a photo or depth image (OpenCV axes), in the frame and unit of its
            component; None if it is refused, or has no camera.
        covariance: (6, 6) of a photo over [rot_rad (3), trans (3)] on the camera's side, ``T = T_hat Exp(xi)``, map
            unit; (7, 7) of a scan over [rot_rad (3), trans (3), log_scale] on the scan's side, in its own unit; None
            if it is refused.
        component: component of the pose; None if none was found.
        scenes: supporting scenes, strongest first: ids, in rows names.
        probability: probability that the pose is right, if refused of the best candidate; 0 without evidence.
    """

    reason: str
    T_map_camera: np.ndarray | None = None
    covariance: np.ndarray | None = None
    component: int | None = None
    scenes: tuple[str, ...] = ()
    probability: float = 0.0


@dataclass(frozen=True, eq=False)
class PhotoLocalization(Localization):
    """The localization of a photo.

    Args:
        intrinsics_px: (4,) ``fx fy cx cy`` in the photo's own size, specified or solved for; None for a scan.
        evidence: evidence values by name.
        num_gaussians: number of Gaussians of the supporting scenes in the photo's field of view.
    """

    intrinsics_px: np.ndarray | None = None
    evidence: Mapping[str, float] = field(default_factory=dict)
    num_gaussians: int = 0


@dataclass(frozen=True, eq=False)
class LocalizationResult(PhotoLocalization):
    """The localization of a photo with its name."""

    name: str = field(kw_only=True)

    @property
    def reason_code(self) -> str:
        """Code of the reason, a key of `gsmap.reason_codes.REASONS`; empty without a reason."""
        return reason_code(self.reason)

    @property
    def is_placed(self) -> bool:
        return not self.reason

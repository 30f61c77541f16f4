"""A photo stored in a map: its pose, date and object observations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from gsmap.errors import InputError

_FAR = 1e9  # beyond any map


@dataclass(frozen=True, eq=False)
class PhotoObjectObservation:
    """The observation of one object in a photo.

    Args:
        position: (3,) position of the object in the photo's scene; objects are matched by position, since ids may
            change.
        state: ``seen`` or ``absent``; unobserved objects are not stored.
        share: fraction of the object's visible surface that was compared.

    Raises:
        InputError: another state, or numbers that cannot be.
    """

    position: np.ndarray
    state: Literal["seen", "absent"]
    share: float

    def __post_init__(self) -> None:
        at = np.asarray(self.position, dtype=np.float64)
        if at.shape != (3,) or not (np.abs(at) < _FAR).all():
            raise InputError("an object observation in a photo needs a position (3,)", code="invalid_record")
        if self.state not in ("seen", "absent") or not 0 <= self.share <= 1:
            raise InputError(
                "an object observation in a photo must be seen or absent, with a fraction in [0, 1]",
                code="invalid_record",
            )
        object.__setattr__(self, "position", at)


@dataclass(frozen=True, eq=False)
class LocalizedPhoto:
    """A localized photo that a map keeps, with its object observations.

    Args:
        digest: SHA-256 of the file (64 hex digits); a photo is stored once.
        name: file name.
        captured_at: ISO 8601, UTC if it had no zone; None if unknown.
        scene: id of the strongest supporting scene, whose frame the pose is in.
        T_scene_camera: (4, 4) camera-to-scene (OpenCV axes), unit of the scene.
        covariance: (6, 6) over [rot_rad (3), trans (3)] on the camera's side, unit of the scene.
        intrinsics_px: (4,) ``fx fy cx cy`` of the photo itself.
        size_px: width and height of the photo itself.
        probability: probability that its pose is right.
        things: object observations.

    Raises:
        InputError: numbers that cannot be.
    """

    digest: str
    name: str
    captured_at: str | None
    scene: str
    T_scene_camera: np.ndarray
    covariance: np.ndarray
    intrinsics_px: np.ndarray
    size_px: tuple[int, int]
    probability: float
    things: tuple[PhotoObjectObservation, ...] = ()

    def __post_init__(self) -> None:
        pose = np.asarray(self.T_scene_camera, np.float64)
        known = np.asarray(self.covariance, np.float64)
        lens = np.asarray(self.intrinsics_px, np.float64)
        shapes = (pose.shape, known.shape, lens.shape)
        if shapes != ((4, 4), (6, 6), (4,)) or not all(np.isfinite(x).all() for x in (pose, known, lens)):
            raise InputError(
                "a photo needs finite arrays: a pose (4, 4), a covariance (6, 6) and intrinsics (4,); got shapes "
                f"{shapes}",
                code="shape_mismatch",
            )
        turn = pose[:3, :3]
        if np.abs(turn @ turn.T - np.eye(3)).max() > 1e-3 or np.linalg.det(turn) < 0 or (np.abs(pose) >= _FAR).any():
            raise InputError("the pose of a photo is not a rigid transform", code="invalid_pose")
        if np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-6 or not 0 <= self.probability <= 1 or (lens[:2] <= 0).any():
            raise InputError("the pose, intrinsics or probability of a photo is invalid", code="invalid_record")
        if len(self.size_px) != 2 or not all(isinstance(n, int) and 0 < n < 10**6 for n in self.size_px):
            raise InputError("the size of a photo must be a positive width and height in pixels", code="invalid_record")
        for name, value in (("T_scene_camera", pose), ("covariance", known), ("intrinsics_px", lens)):
            object.__setattr__(self, name, value)

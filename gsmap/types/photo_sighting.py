"""A photograph that a map keeps: where it was taken, when, and what it shows of the map's things."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from gsmap.errors import InputError

_FAR = 1e9  # beyond any map


@dataclass(frozen=True, eq=False)
class ThingInPhoto:
    """What a photograph says of one thing.

    Args:
        position: (3,) of the thing, frame of the photo's scene: things are known by their place, whose ids may change.
        state: ``seen`` or ``absent``; of what the photo does not show nothing is kept.
        share: of the thing's visible surface that could be compared.

    Raises:
        InputError: another state, or numbers that cannot be.
    """

    position: np.ndarray
    state: Literal["seen", "absent"]
    share: float

    def __post_init__(self) -> None:
        at = np.asarray(self.position, dtype=np.float64)
        if at.shape != (3,) or not (np.abs(at) < _FAR).all():
            raise InputError("a thing in a photo needs a place of three numbers", code="invalid_record")
        if self.state not in ("seen", "absent") or not 0 <= self.share <= 1:
            raise InputError("a thing in a photo is seen or absent, by a share in [0, 1]", code="invalid_record")
        object.__setattr__(self, "position", at)


@dataclass(frozen=True, eq=False)
class PhotoSighting:
    """A photograph that a map keeps as evidence.

    Args:
        digest: SHA-256 of the file (64 hex digits): the same photo is kept once.
        name: of the file.
        captured_at: ISO 8601, UTC where it had no zone; None where nothing says it.
        scene: id of the one that supports its pose most, in whose frame that is: it moves with the map.
        T_scene_camera: (4, 4) camera-to-scene (OpenCV axes), unit of the scene.
        covariance: (6, 6) over [rot_rad (3), trans (3)] on the camera's side, unit of the scene.
        intrinsics_px: (4,) ``fx fy cx cy`` of the photo itself.
        size_px: width and height of the photo itself.
        probability: that its pose is right.
        things: what it says of things of the map.

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
    things: tuple[ThingInPhoto, ...] = ()

    def __post_init__(self) -> None:
        pose = np.asarray(self.T_scene_camera, np.float64)
        known = np.asarray(self.covariance, np.float64)
        lens = np.asarray(self.intrinsics_px, np.float64)
        shapes = (pose.shape, known.shape, lens.shape)
        if shapes != ((4, 4), (6, 6), (4,)) or not all(np.isfinite(x).all() for x in (pose, known, lens)):
            raise InputError(
                f"a photo needs a pose (4, 4), a covariance (6, 6) and intrinsics (4,), got {shapes}",
                code="shape_mismatch",
            )
        turn = pose[:3, :3]
        if np.abs(turn @ turn.T - np.eye(3)).max() > 1e-3 or np.linalg.det(turn) < 0 or (np.abs(pose) >= _FAR).any():
            raise InputError("the pose of a photo is no rigid transform", code="invalid_pose")
        if np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-6 or not 0 <= self.probability <= 1 or (lens[:2] <= 0).any():
            raise InputError("the pose, intrinsics or probability of a photo cannot be", code="invalid_record")
        if len(self.size_px) != 2 or not all(isinstance(n, int) and 0 < n < 10**6 for n in self.size_px):
            raise InputError("a photo has a width and a height in pixels", code="invalid_record")
        for name, value in (("T_scene_camera", pose), ("covariance", known), ("intrinsics_px", lens)):
            object.__setattr__(self, name, value)

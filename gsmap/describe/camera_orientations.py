"""Estimate the vertical from the camera orientations of a capture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.types import Cameras

_STEEP = 0.85  # cosine: within 32 degrees of straight down or up the up direction of images is unreliable
_UPWARD = np.sin(np.radians(20))  # cameras that look up by more than this on average may be upside down
_ROLL = np.sin(np.radians(20))  # the rows or the columns of a level camera are tilted by less than this
_SWAY = 0.2  # of the distance to the scene: a narrower path may come from swaying arms
_THIN = 0.35  # a path that rises and falls by less than this share of its width is level


@dataclass(frozen=True)
class VerticalEstimate:
    """A vertical estimated from cameras that rotate about it.

    Args:
        up: (3,) unit vector against gravity.
        cone_deg: largest error in degrees.
        sure: True if the sign is known.
    """

    up: np.ndarray
    cone_deg: float
    sure: bool


@dataclass(frozen=True, eq=False)
class CameraOrientations:
    """Camera orientations of a capture.

    Args:
        rotation: (C, 3, 3) rotations from camera (OpenCV axes) to frame.
        centres: (C, 3) camera centres in the frame.
    """

    rotation: np.ndarray
    centres: np.ndarray

    @classmethod
    def of(cls, cameras: Cameras) -> CameraOrientations:
        return cls(cameras.T_frame_camera[:, :3, :3], cameras.T_frame_camera[:, :3, 3])

    @property
    def mean(self) -> np.ndarray:
        """Mean right, down and forward axes of the cameras, as columns (3, 3)."""
        mean: np.ndarray = self.rotation.mean(0)
        return mean

    @property
    def at_all_angles(self) -> bool:
        """True if cameras look in all directions, as around an object, so that no image direction is constant."""
        return bool(np.linalg.norm(self.mean, axis=0).max() < 0.3)

    def is_allowed(self, up: np.ndarray) -> bool:
        """Return whether cameras with one heading may have this vertical: they are neither upside down nor look up, and
        an image edge is level."""
        right, down, forward = self.mean.T
        level = min(abs(right @ up), abs(down @ up)) < _ROLL
        # The camera is upright; or it is on its side or looks straight down, and then the image's up direction is
        # level.
        return bool(level and down @ up < _ROLL and forward @ up < _UPWARD)

    def is_upright(self, up: np.ndarray) -> bool:
        """Return whether the up direction of the images gives the sign of a vertical: cameras are neither on their side
        nor look straight down."""
        return bool(-self.mean[:, 1] @ up > 0.25)

    def looks_along(self, axis: np.ndarray) -> bool:
        """Return whether the cameras look along an axis, in either direction."""
        return bool(abs(self.mean[:, 2] @ axis) > _STEEP)

    def normal_of_path(self, points: np.ndarray) -> np.ndarray | None:
        """Estimate the axis (3,) along which the cameras move far less than along both other axes; its sign is
        arbitrary.

        Args:
            points: (N, 3) points of the scene. If cameras move little, compared with the distance to these, the result
                is None.
        """
        if len(self.centres) < 6:
            return None
        values, vectors = np.linalg.eigh(np.cov(self.centres.T))
        away = np.median(np.linalg.norm(self.centres - np.median(points, axis=0), axis=1))
        wide = values[1] > max(0.1**2 * values[2], (_SWAY * away) ** 2) and values[0] < _THIN**2 * values[1]
        return vectors[:, 0] if wide else None

    def normal_of_rows(self) -> np.ndarray | None:
        """Estimate the axis (3,) about which the cameras rotate far more than they roll; its sign is arbitrary."""
        right = self.rotation[:, :, 0]
        values, vectors = np.linalg.eigh(right.T @ right / len(right))
        small = values[1] > np.sin(np.radians(5)) ** 2 and values[0] < 0.4**2 * values[1]
        return vectors[:, 0] if small else None


def estimate_turn_axis(cameras: CameraOrientations) -> VerticalEstimate | None:
    """Estimate the axis about which cameras rotate; None if they have one heading or look in all directions.

    The axis is the direction that is constant in all images, whatever their pitch and roll. With ``b`` in the camera,
    ``a`` in the frame and ``R`` from camera to frame, it is the pair with the largest mean ``a . R b``: the first
    singular vectors of the mean rotation. If the pitch varies too much for that, it is the axis most nearly
    perpendicular to the rows of all images. The sign follows from the images' up direction or, for views from straight
    above, from the viewing direction.
    """
    axis, cone_deg, mean = _kept(cameras), 15.0, cameras.mean
    if axis is None:
        axis = _level(cameras)
    if axis is None and _spread(mean):
        axis, cone_deg = -mean[:, 1] / np.linalg.norm(mean[:, 1]), 25.0
    if axis is None:
        return None
    up, forward = -mean[:, 1] @ axis, mean[:, 2] @ axis
    if abs(up) > 0.25:
        sign = np.sign(up)
        return VerticalEstimate(axis * sign, cone_deg, sure=bool(forward * sign < _UPWARD))
    sign = -np.sign(forward) or 1.0
    # The cameras are on their side: only steep views determine the sign.
    return VerticalEstimate(axis * sign, cone_deg, sure=bool(abs(forward) > _STEEP))


def _kept(cameras: CameraOrientations) -> np.ndarray | None:
    """Estimate the axis of a rotation at constant pitch and roll, if the rotation is large compared with their
    variation."""
    axes, kept, _ = np.linalg.svd(cameras.mean)
    lost, turned = 1 - kept[:2]
    return axes[:, 0] if turned > 0.08 and lost < 0.15 * turned else None


def _level(cameras: CameraOrientations) -> np.ndarray | None:
    """Estimate the axis perpendicular to the rows of all images, if the rows turn far enough to determine one."""
    right = cameras.rotation[:, :, 0]
    values, vectors = np.linalg.eigh(right.T @ right / len(right))
    # Over less than half a turn, tilted rows seem to turn about a tilted axis.
    askew = 0.25 if values[1] > 0.3 else 0.05
    return vectors[:, 0] if values[1] > 0.1 and values[0] < askew * values[1] else None


def _spread(mean: np.ndarray) -> bool:
    """Return whether images are mostly upright and look in all directions about the vertical."""
    down = np.linalg.norm(mean[:, 1])
    if down < 0.3:
        return False
    up = -mean[:, 1] / down
    level = mean[:, 2] - (mean[:, 2] @ up) * up
    return bool(np.linalg.norm(level) < 0.5 and np.linalg.norm(mean[:, 0]) < 0.5)

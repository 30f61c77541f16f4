"""How a camera was turned, as a single match says: a feature has a frame, of the ray to it and the turn it has there.

Where the photo sees a feature from the side that the view saw it from, the frame of both is one, and the camera's is
told by it; the farther to the side, the less so. It is exact to some 20 degrees for most right matches, and wrong for
most wrong ones.
"""

from __future__ import annotations

import numpy as np

from gsmap.geometry.rotations import conjugate_quats, matrices_to_quats, multiply_quats
from gsmap.types.localization import Keypoints, SceneFeatures


def in_camera(found: Keypoints, intrinsics_px: np.ndarray) -> np.ndarray:
    """(N, 4) quaternions ``wxyz`` of the frames of features in that of their camera; see `frames`."""
    angles = np.zeros(len(found)) if found.angles_rad is None else found.angles_rad
    return frames(found.pixels, angles, intrinsics_px)


def in_scene(found: SceneFeatures, rows: np.ndarray, view: np.ndarray) -> np.ndarray:
    """(n, 4) of the frames of some features in that of their scene.

    Args:
        rows: (n,) which features.
        view: (n,) of which views they are.
    """
    cameras, out = found.cameras, np.empty((len(rows), 4))
    for number in np.unique(view):
        mine = np.flatnonzero(view == number)
        T = cameras.T_frame_camera[number]
        local = (found.points[rows[mine]] - T[:3, 3]) @ T[:3, :3]
        fx, fy, cx, cy = cameras.intrinsics_px[number]
        pixels = local[:, :2] / np.maximum(local[:, 2:], 1e-9) * [fx, fy] + [cx, cy]
        turns = frames(pixels, found.angles[rows[mine]] * (np.pi / 128), cameras.intrinsics_px[number])
        out[mine] = multiply_quats(matrices_to_quats(T[:3, :3]), turns)
    return out


def of_camera(in_scene: np.ndarray, in_camera: np.ndarray) -> np.ndarray:
    """(K, 4) how the camera was turned in the scene, as matches say: their frames in the scene and in the camera."""
    return multiply_quats(in_scene, conjugate_quats(in_camera))


def frames(pixels: np.ndarray, angles_rad: np.ndarray, intrinsics_px: np.ndarray) -> np.ndarray:
    """(N, 4) quaternions ``wxyz`` of the frames of features in that of their camera.

    The third axis is the ray of a feature; the first is across it, the way that it was turned before it was described.
    """
    fx, fy, cx, cy = intrinsics_px
    ray = np.stack([(pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy, np.ones(len(pixels))], axis=1)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    along = np.stack([np.cos(angles_rad), np.sin(angles_rad), np.zeros(len(pixels))], axis=1)
    along -= (along * ray).sum(1, keepdims=True) * ray
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    return matrices_to_quats(np.stack([along, np.cross(ray, along), ray], axis=2))


def rolled(turn: np.ndarray, said: np.ndarray) -> np.ndarray:
    """A camera's quaternion (1, 4) rolled about its axis, as most of what others say of it (N, 4) have it."""
    off = multiply_quats(conjugate_quats(turn), said)
    twist = (off[:, 0] + 1j * off[:, 3]) ** 2  # of twice the half angle, so that a quaternion and its negative are one
    half = np.angle(twist.sum()) / 2
    out: np.ndarray = multiply_quats(turn, np.array([[np.cos(half), 0.0, 0.0, np.sin(half)]]))
    return out


def alike(one: np.ndarray, other: np.ndarray, max_deg: float) -> np.ndarray:
    """(N, M) bool: quaternions (N, 4) and (M, 4) that are turned by so much at most from one to the other."""
    out: np.ndarray = np.abs(one @ other.T) >= np.cos(np.radians(max_deg / 2))
    return out

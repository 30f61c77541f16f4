"""Estimate a camera's orientation from a single match, by the coordinate frames of features.

A feature has a coordinate frame: its ray, and its orientation across the ray. If photo and view see a feature from the
same direction, both frames coincide, which gives the camera's orientation. The more the directions differ, the less
accurate it is: within some 20 degrees for most correct matches, and random for most wrong matches.
"""

from __future__ import annotations

import numpy as np

from gsmap.geometry.rotations import conjugate_quats, matrices_to_quats, multiply_quats
from gsmap.types.localization import Keypoints, SceneFeatures


def camera_frames(found: Keypoints, intrinsics_px: np.ndarray) -> np.ndarray:
    """Return the (N, 4) quaternions ``wxyz`` of the frames of features in their camera; see `feature_frames`."""
    angles = np.zeros(len(found)) if found.angles_rad is None else found.angles_rad
    return feature_frames(found.pixels, angles, intrinsics_px)


def scene_frames(found: SceneFeatures, rows: np.ndarray, view: np.ndarray) -> np.ndarray:
    """Return the (n, 4) quaternions of the frames of features in their scene.

    Args:
        rows: (n,) rows of the features.
        view: (n,) views of the features.
    """
    cameras, out = found.cameras, np.empty((len(rows), 4))
    for number in np.unique(view):
        chosen = np.flatnonzero(view == number)
        T = cameras.T_frame_camera[number]
        local = (found.points[rows[chosen]] - T[:3, 3]) @ T[:3, :3]
        fx, fy, cx, cy = cameras.intrinsics_px[number]
        pixels = local[:, :2] / np.maximum(local[:, 2:], 1e-9) * [fx, fy] + [cx, cy]
        frames = feature_frames(pixels, found.angles[rows[chosen]] * (np.pi / 128), cameras.intrinsics_px[number])
        out[chosen] = multiply_quats(matrices_to_quats(T[:3, :3]), frames)
    return out


def camera_orientations(in_scene: np.ndarray, in_camera: np.ndarray) -> np.ndarray:
    """Return the (K, 4) orientations of the camera in the scene that follow from matched frames in the scene and in the
    camera."""
    return multiply_quats(in_scene, conjugate_quats(in_camera))


def feature_frames(pixels: np.ndarray, angles_rad: np.ndarray, intrinsics_px: np.ndarray) -> np.ndarray:
    """Return the (N, 4) quaternions ``wxyz`` of the frames of features in their camera.

    The third axis is the ray of a feature; the first is the direction of the feature across the ray.
    """
    fx, fy, cx, cy = intrinsics_px
    ray = np.stack([(pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy, np.ones(len(pixels))], axis=1)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    along = np.stack([np.cos(angles_rad), np.sin(angles_rad), np.zeros(len(pixels))], axis=1)
    along -= (along * ray).sum(1, keepdims=True) * ray
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    return matrices_to_quats(np.stack([along, np.cross(ray, along), ray], axis=2))


def fit_roll(orientation: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Rotate a camera's orientation (1, 4) about its optical axis so that it best fits the orientations from matches
    (N, 4)."""
    off = multiply_quats(conjugate_quats(orientation), others)
    twist = (off[:, 0] + 1j * off[:, 3]) ** 2  # squared, so that a quaternion and its negative give the same value
    half = np.angle(twist.sum()) / 2
    out: np.ndarray = multiply_quats(orientation, np.array([[np.cos(half), 0.0, 0.0, np.sin(half)]]))
    return out


def within_angle(one: np.ndarray, other: np.ndarray, max_deg: float) -> np.ndarray:
    """Return an (N, M) mask of pairs of quaternions, (N, 4) and (M, 4), that differ by a rotation of at most
    ``max_deg``."""
    out: np.ndarray = np.abs(one @ other.T) >= np.cos(np.radians(max_deg / 2))
    return out

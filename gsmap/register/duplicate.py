"""Detect duplicates: two scenes that come from one capture, which was converted, thinned or trained again."""

from __future__ import annotations

import numpy as np

from gsmap.geometry.umeyama import umeyama
from gsmap.register.scene_view import SceneView
from gsmap.types import Registration, Sim3

SAME_CAPTURE = "the same capture"
_MIN_OVERLAP = 0.5  # smallest overlap of duplicates
_MIN_SHARE = 0.9  # smallest share of the smaller scene's Gaussians, or cameras, that coincide
_POINTS = 3000
_NEAREST = 8  # Gaussians around each point, among which the nearest one is after the points were aligned
_BLOCK = 500_000
# Gaussians of independent trainings lie about half their spacing from the nearest Gaussian of the other scene (2D
# Poisson: the mean nearest distance to another set equals that within a set); Gaussians of one training coincide.
_SPACING_SHARE = 0.1
_MIN_CAMERAS = 5
_CAMERA_SHARE = 0.005  # of the distance from camera to scene: no second visit repeats every position to a centimetre
_CAMERA_DEG = 1.0


def find_duplicate(target: SceneView, source: SceneView, found: Registration) -> str:
    """Return a message if the scenes of an accepted pair are duplicates of one capture; empty if not."""
    S = found.S_target_source
    if found.status != "accepted" or S is None or found.overlap < _MIN_OVERLAP:
        return ""
    share = _coinciding_gaussians(target, source, S)
    if share >= _MIN_SHARE:
        return f"{SAME_CAPTURE} twice: {share:.0%} of the Gaussians of the smaller scene are in the other scene"
    shared, of = _coinciding_cameras(target, source, S)
    if of >= _MIN_CAMERAS and shared >= _MIN_SHARE * of:
        return f"{SAME_CAPTURE} trained twice: {shared} of {of} cameras of one scene are in the other scene"
    return ""


def _coinciding_gaussians(target: SceneView, source: SceneView, S_target_source: Sim3) -> float:
    """Return the share of the smaller scene's Gaussians that coincide with a Gaussian of the other scene."""
    is_target_large = len(target.gaussians) >= len(source.gaussians)
    large, small = (target, source) if is_target_large else (source, target)
    into_large = S_target_source if is_target_large else S_target_source.inverse()
    few = into_large.apply(_evenly(small.gaussians.means, _POINTS))
    means = large.gaussians.means
    nearest, _ = _nearest(means, np.concatenate([few, _evenly(means, len(few))]))
    spacing = np.linalg.norm(nearest[len(few) :, 1] - nearest[len(few) :, 0], axis=1)
    distance, _ = _align_closely(nearest[: len(few)], few)
    return float((distance < _SPACING_SHARE * np.median(spacing)).mean())


def _evenly(points: np.ndarray, count: int) -> np.ndarray:
    """Return at most ``count`` of the points (N, 3), evenly spread over the rows, as float64."""
    return points[np.linspace(0, len(points) - 1, min(len(points), count)).astype(int)].astype(np.float64)


def _nearest(points: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (M, K, 3) nearest to each position (M, 3), the nearest first, and their rows (M, K).

    Where there are fewer points than K, they are at infinity.
    Points are searched in blocks, since a tree of a large scene takes more memory than the scene.
    """
    from scipy.spatial import cKDTree  # imported here, as the recipe key does not need it

    distance, rows = np.full((len(at), _NEAREST), np.inf), np.zeros((len(at), _NEAREST), np.int64)
    for start in range(0, len(points), _BLOCK):
        tree = cKDTree(points[start : start + _BLOCK].astype(np.float64), balanced_tree=False, compact_nodes=False)
        near, row = tree.query(at, k=_NEAREST)
        near, row = np.concatenate([distance, near], axis=1), np.concatenate([rows, start + row], axis=1)
        order = np.argsort(near, axis=1, kind="stable")[:, :_NEAREST]
        distance, rows = np.take_along_axis(near, order, 1), np.take_along_axis(row, order, 1)
    is_there = np.isfinite(distance)
    rows = np.where(is_there, rows, 0)
    return np.where(is_there[..., None], points[rows].astype(np.float64), np.inf), rows


def _align_closely(nearest: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Align points (M, 3) with the nearest points (M, K, 3) of a set, and return the distances to these and which of
    the K they are. Only the nearer half is aligned, because the refined pose may be off by a millimetre, which may be
    as much as the spacing."""
    rows = np.arange(len(points))
    for turn in range(5):
        apart = np.linalg.norm(nearest - points[:, None], axis=2)
        which = apart.argmin(1)
        distance = apart[rows, which]
        if turn < 4:
            near = np.argsort(distance)[: max(3, len(points) // 2)]
            points = umeyama(nearest[near, which[near]], points[near]).apply(points)
    return distance, which


def _coinciding_cameras(target: SceneView, source: SceneView, S_target_source: Sim3) -> tuple[int, int]:
    """Return two numbers for the scene with fewer cameras: how many of its cameras have the pose of a camera of the
    other scene, and how many cameras it has."""
    ours, theirs = target.cameras, source.cameras
    if not ours or not theirs or ours.synthesised or theirs.synthesised or min(len(ours), len(theirs)) < _MIN_CAMERAS:
        return 0, 0
    poses = ours.T_frame_camera, theirs.T_frame_camera
    centres = poses[0][:, :3, 3], S_target_source.apply(poses[1][:, :3, 3])
    forward = poses[0][:, :3, 2], poses[1][:, :3, 2] @ S_target_source.rotation.T
    few, many = (0, 1) if len(centres[0]) < len(centres[1]) else (1, 0)
    away = np.median(np.linalg.norm(centres[0] - target.centre, axis=1))
    nearest, rows = _nearest(centres[many], centres[few])
    distance, which = _align_closely(nearest, centres[few])
    row = rows[np.arange(len(rows)), which]
    same_direction = (forward[few] * forward[many][row]).sum(1) > np.cos(np.radians(_CAMERA_DEG))
    return int(np.sum((distance < _CAMERA_SHARE * away) & same_direction)), len(distance)

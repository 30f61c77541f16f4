"""Detect duplicates: two scenes that come from one capture, which was converted, thinned or trained again."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gsmap.geometry.umeyama import umeyama
from gsmap.register.scene_view import SceneView
from gsmap.types import Registration, Sim3

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

SAME_CAPTURE = "the same capture"
_MIN_OVERLAP = 0.5  # smallest overlap of duplicates
_MIN_SHARE = 0.9  # smallest share of the smaller scene's Gaussians, or cameras, that coincide
_POINTS = 3000
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
    from scipy.spatial import cKDTree  # imported here, as the recipe key does not need it

    means, moved = target.gaussians.means.astype(float), S_target_source.apply(source.gaussians.means)
    large, small = (means, moved) if len(means) >= len(moved) else (moved, means)
    small = small[np.linspace(0, len(small) - 1, min(len(small), _POINTS)).astype(int)]
    tree = cKDTree(large, balanced_tree=False, compact_nodes=False)
    spacing = tree.query(large[np.linspace(0, len(large) - 1, len(small)).astype(int)], k=2)[0][:, 1]
    distance, _ = _align_closely(tree, small)
    return float((distance < _SPACING_SHARE * np.median(spacing)).mean())


def _align_closely(tree: cKDTree, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Align points with the nearest points of a set, and return the distances to these and their rows. Only the nearer
    half is aligned, because the refined pose may be off by a millimetre, which may be as much as the spacing."""
    for _ in range(4):
        distance, row = tree.query(points)
        near = np.argsort(distance)[: max(3, len(points) // 2)]
        points = umeyama(tree.data[row[near]], points[near]).apply(points)
    distance, row = tree.query(points)
    return distance, row


def _coinciding_cameras(target: SceneView, source: SceneView, S_target_source: Sim3) -> tuple[int, int]:
    """Return two numbers for the scene with fewer cameras: how many of its cameras have the pose of a camera of the
    other scene, and how many cameras it has."""
    from scipy.spatial import cKDTree

    ours, theirs = target.cameras, source.cameras
    if not ours or not theirs or ours.synthesised or theirs.synthesised or min(len(ours), len(theirs)) < _MIN_CAMERAS:
        return 0, 0
    poses = ours.T_frame_camera, theirs.T_frame_camera
    centres = poses[0][:, :3, 3], S_target_source.apply(poses[1][:, :3, 3])
    forward = poses[0][:, :3, 2], poses[1][:, :3, 2] @ S_target_source.rotation.T
    few, many = (0, 1) if len(centres[0]) < len(centres[1]) else (1, 0)
    away = np.median(np.linalg.norm(centres[0] - target.centre, axis=1))
    distance, row = _align_closely(cKDTree(centres[many]), centres[few])
    same_direction = (forward[few] * forward[many][row]).sum(1) > np.cos(np.radians(_CAMERA_DEG))
    return int(np.sum((distance < _CAMERA_SHARE * away) & same_direction)), len(distance)

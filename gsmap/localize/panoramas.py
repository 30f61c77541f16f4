"""Localize a panorama or a wide fisheye photo by its faces, whose relative rotations are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gsmap.reason_codes import reason
from gsmap.types.localization import LocalizationResult, Photo

_MAX_ANGLE_DEG = 5.0  # between the poses of two faces that agree
_MAX_SIGMAS = 6.0  # of their positions


def combine_faces(photo: Photo, found: Sequence[LocalizationResult]) -> LocalizationResult:
    """Return the pose of a photo from the results of its faces.

    The photo is placed where one face is, or several that agree; the mean weights them by their covariances. It is
    refused if no face is placed, or if faces are placed apart and neither place has more of them.

    Args:
        photo: a photo with faces.
        found: the result of each face.
    """
    poses = [_pose_of_photo(one, turn) for one, (_, turn) in zip(found, photo.faces, strict=True)]
    placed = [pose for pose in poses if pose is not None]
    if not placed:
        return replace(max(found, key=lambda one: one.probability), name=photo.name, intrinsics_px=None)
    groups = [[other for other in placed if _agree(pose, other)] for pose in placed]
    best = max(groups, key=lambda group: (len(group), max(one.probability for one in group)))
    others = len(placed) - len(best)
    if others >= len(best):
        why = reason("ambiguous", "ambiguous: its faces are placed apart")
        first = best[0]
        return LocalizationResult(
            why, name=photo.name, component=first.component, probability=first.probability, evidence=first.evidence
        )
    return _mean(photo.name, best)


def _pose_of_photo(found: LocalizationResult, turn: np.ndarray) -> LocalizationResult | None:
    """Return the pose of a photo by one face, whose frame a rotation ``R_photo_face`` (3, 3) turns; None if refused."""
    if found.T_map_camera is None or found.covariance is None:
        return None
    pose = found.T_map_camera.copy()
    pose[:3, :3] = pose[:3, :3] @ turn.T
    both = np.kron(np.eye(2), turn)
    return replace(found, T_map_camera=pose, covariance=both @ found.covariance @ both.T)


def _agree(a: LocalizationResult, b: LocalizationResult) -> bool:
    if a.component != b.component:
        return False
    assert a.T_map_camera is not None and b.T_map_camera is not None  # noqa: PT018
    assert a.covariance is not None and b.covariance is not None  # noqa: PT018
    relative = np.linalg.inv(a.T_map_camera) @ b.T_map_camera
    angle = np.degrees(np.arccos(np.clip((np.trace(relative[:3, :3]) - 1) / 2, -1, 1)))
    variance = np.trace(a.covariance[3:, 3:]) + np.trace(b.covariance[3:, 3:])
    return bool(angle <= _MAX_ANGLE_DEG and np.linalg.norm(relative[:3, 3]) <= _MAX_SIGMAS * np.sqrt(variance))


def _mean(name: str, group: Sequence[LocalizationResult]) -> LocalizationResult:
    """Return the weighted mean of poses that agree; its covariance grows where they scatter more than they should."""
    from scipy.spatial.transform import Rotation

    first = max(group, key=lambda one: one.probability)
    assert first.T_map_camera is not None
    information, moved, squares = np.zeros((6, 6)), np.zeros(6), 0.0
    steps = []
    for one in group:
        assert one.T_map_camera is not None
        assert one.covariance is not None
        relative = np.linalg.inv(first.T_map_camera) @ one.T_map_camera
        step = np.concatenate([Rotation.from_matrix(relative[:3, :3]).as_rotvec(), relative[:3, 3]])
        weight = np.linalg.inv(one.covariance)
        information, moved = information + weight, moved + weight @ step
        steps.append((step, weight))
    covariance = np.linalg.inv(information)
    mean = covariance @ moved
    squares = sum(float((step - mean) @ weight @ (step - mean)) for step, weight in steps)
    covariance *= max(1.0, squares / max(6 * (len(group) - 1), 1))
    change = np.eye(4)
    change[:3, :3], change[:3, 3] = Rotation.from_rotvec(mean[:3]).as_matrix(), mean[3:]
    return replace(
        first,
        name=name,
        T_map_camera=first.T_map_camera @ change,
        covariance=covariance,
        scenes=tuple(dict.fromkeys(scene for one in group for scene in one.scenes)),
        intrinsics_px=None,
        probability=float(1 - np.prod([1 - one.probability for one in group])),
        evidence={**first.evidence, "num_faces": float(len(group))},
    )

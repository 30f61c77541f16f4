"""Localize photos of control points that are not cameras of a scene, and express their poses in scene frames."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.errors import NotFoundError
from gsmap.formats.pictures import open_picture
from gsmap.geometry.transforms import transform_poses
from gsmap.store import Store
from gsmap.types import ScenePose
from gsmap.types.rows.localize import LocalizeRow


@dataclass(frozen=True, eq=False)
class PhotoPose:
    """The pose of a localized photo in the frame of a scene.

    Args:
        scene: id of the scene that supports the pose.
        T_scene_camera: (4, 4).
        intrinsics_px: (4,) ``fx fy cx cy``. size_px: (2,) width, height.
        covariance: (6, 6) over [rotation (3, rad), translation (3, scene unit)] on the camera's side.
    """

    scene: str
    T_scene_camera: np.ndarray
    intrinsics_px: np.ndarray
    size_px: tuple[int, int]
    covariance: np.ndarray


LocalizePhotos = Callable[[Sequence[str]], dict[str, PhotoPose]]
"""A function that maps the names of photos, as the files have them, to the poses of photos that were localized."""


def photo_localizer(store: Store, localize: Callable[..., Any], folder: str | os.PathLike[str]) -> LocalizePhotos:
    """Return a function that localizes photos of a folder in the map.

    Args:
        localize: `Map.localize`: files in, a report with a row for each (``results``) out.

    Raises:
        NotFoundError: no such folder.
    """
    root = Path(folder)
    if not root.is_dir():
        raise NotFoundError(f"there is no folder of photos at {root}", code="folder_not_found")

    def localise(names: Sequence[str]) -> dict[str, PhotoPose]:
        files = {name: root / name for name in names if _inside(root, name)}
        if not files:
            return {}
        rows: Sequence[LocalizeRow] = localize(*files.values()).results
        poses, ids = store.revisions.poses(), {scene.name: scene.id for scene in store.scenes.list()}
        found = {}
        for (name, path), row in zip(files.items(), rows, strict=True):
            placed = photo_pose_of(row, _size(path), poses, ids)
            if placed is not None:
                found[name] = placed
        return found

    return localise


def photo_pose_of(
    row: LocalizeRow, size_px: tuple[int, int], poses: Mapping[str, ScenePose], ids: Mapping[str, str]
) -> PhotoPose | None:
    """Return the pose of a photo in the frame of its best supporting scene, with which the photo moves when poses
    change; None if the photo was refused.

    A photo is tied to what it was found by: when the map is bent, it moves with that scene.

    Args:
        poses: by scene id. ids: by scene name.
    """
    if row.T_map_camera is None or row.covariance is None or row.intrinsics_px is None:
        return None
    known = [ids[name] for name in row.scenes if name in ids and ids[name] in poses]
    scene = next((one for one in known if poses[one].component == row.component), None)
    if scene is None:
        return None
    S_scene_map = poses[scene].S_map_scene.inverse()
    pose = transform_poses(row.T_map_camera, S_scene_map)
    # Both covariances are on the camera's side; lengths become the scene's.
    unit = np.diag([1.0] * 3 + [S_scene_map.scale] * 3)
    return PhotoPose(scene, pose, np.asarray(row.intrinsics_px), size_px, unit @ row.covariance @ unit)


def _inside(root: Path, name: str) -> bool:
    """Return true if a name from a file leads to a photo below the folder."""
    path = root / name
    return path.is_file() and path.resolve().is_relative_to(root.resolve())


def _size(path: Path) -> tuple[int, int]:
    """Return the width and height of the upright image."""
    from PIL import ImageOps

    with open_picture(path) as picture:
        width, height = ImageOps.exif_transpose(picture).size
    return width, height

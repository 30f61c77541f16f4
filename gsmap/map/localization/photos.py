"""Record localized photos with the objects that they show, and report stored photos as rows."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from io import BytesIO

import numpy as np
from PIL import Image

from gsmap.geometry.projection import in_image, project
from gsmap.geometry.transforms import transform_poses
from gsmap.localize import PhotoComparison
from gsmap.map.localization.photo_poses import photo_pose_of
from gsmap.store import Store
from gsmap.store.photos import MAX_BYTES
from gsmap.types import MapObject, SceneGraph, Sim3
from gsmap.types.localization import Photo
from gsmap.types.localized_photo import LocalizedPhoto, PhotoObjectObservation
from gsmap.types.rows.localize import LocalizeRow, PhotoChangeRow, PhotoRow

_ON_SURFACE_M = 0.12  # distance of a sample of an object from the rendered surface, up to which it is visible
_MIN_SAMPLES, _MIN_VISIBLE_FRACTION = 8, 0.1  # of an object that must be visible for it to be judged
_MIN_SEEN_FRACTION = 0.6  # of the visible samples that must agree with the map for the object to be seen
_MIN_GONE_FRACTION = 0.5  # of the visible samples that must lie in changed regions for it to be absent
_SIDE_PX = 960  # of the picture that is kept: as large as captures are rendered for the merged map to look like


@dataclass(frozen=True, eq=False)
class PhotoObservation:
    """The comparison of one localized photo with the map.

    Args:
        found: the differences.
        rows: the differences as rows.
        notes: remarks for the user.
    """

    found: PhotoComparison
    rows: tuple[PhotoChangeRow, ...]
    notes: tuple[str, ...]


def localized_photo_of(
    store: Store, row: LocalizeRow, photo: Photo, things: Sequence[PhotoObjectObservation], captured_at: str | None
) -> LocalizedPhoto | None:
    """Return the record to store for a localized photo; None if its supporting scene is gone.

    Args:
        things: object observations, positions in the map frame.
    """
    poses, ids = store.revisions.poses(), {scene.name: scene.id for scene in store.scenes.list()}
    placed = photo_pose_of(row, photo.size_px, poses, ids)
    if placed is None:
        return None
    S_scene_map = poses[placed.scene].S_map_scene.inverse()
    width, height = placed.size_px
    return LocalizedPhoto(
        digest=digest_of(row.file, photo),
        name=os.path.basename(row.file) or "photo",
        captured_at=captured_at,
        scene=placed.scene,
        T_scene_camera=placed.T_scene_camera,
        covariance=placed.covariance,
        intrinsics_px=placed.intrinsics_px,
        size_px=(int(width), int(height)),
        probability=row.probability,
        things=tuple(replace(one, position=S_scene_map.apply(one.position)) for one in things),
    )


def digest_of(file: str, photo: Photo) -> str:
    """Return the SHA-256 of a photo's file, or of the pixels of a video frame."""
    made = hashlib.sha256()
    if os.path.isfile(file):
        with open(file, "rb") as stream:
            for part in iter(partial(stream.read, 1 << 20), b""):
                made.update(part)
    else:
        made.update(f"{photo.rgb.shape}".encode() + photo.rgb.tobytes())
    return made.hexdigest()


def small_jpeg(photo: Photo) -> bytes:
    """Encode a photo as the JPEG that the map stores."""
    image = Image.fromarray(photo.rgb)
    image.thumbnail((_SIDE_PX, _SIDE_PX))
    for quality in (82, 60, 30):
        content = BytesIO()
        image.save(content, "JPEG", quality=quality)
        if content.tell() <= MAX_BYTES:
            break
    return content.getvalue()


def objects_in_photo(
    told: PhotoObservation,
    row: LocalizeRow,
    unit: float,
    objects: Sequence[MapObject],
    graph_of: Callable[[str], SceneGraph | None],
    poses: Mapping[str, Sim3],
) -> list[PhotoObjectObservation]:
    """Return the objects of its component that a localized photo shows, and the objects whose absence it shows.

    An object is in sight where the map, seen from the photo, shows its surface: where something the map has stands
    before it nothing is said, and neither where something new does.

    Args:
        unit: metres per unit of the map.
        poses: ``S_map_scene`` by scene id.
    """
    assert row.T_map_camera is not None
    assert row.intrinsics_px is not None
    height, width = told.found.compared.shape
    hidden = np.zeros((height, width), bool)
    gone = np.zeros((height, width), bool)
    for region in told.found.regions:
        (hidden if region.kind in ("appeared", "recoloured") else gone)[region.mask] = True
    T_camera_map = np.linalg.inv(row.T_map_camera)
    lens = row.intrinsics_px * told.found.scale
    out = []
    for thing in objects:
        points = _points(thing, graph_of, poses) if thing.component == row.component else None
        if points is None:
            continue
        pixels, depth = project(points, T_camera_map, lens)
        rows = np.flatnonzero(in_image(pixels, depth, np.array([width, height])))
        column, line = pixels[rows].astype(np.int64).T
        surface = told.found.points[line, column]
        far = np.linalg.norm(surface - points[rows] * unit, axis=1)  # NaN where nothing was compared
        on = far < _ON_SURFACE_M
        column, line = column[on], line[on]
        share = len(column) / len(points)
        if len(column) < _MIN_SAMPLES or share < _MIN_VISIBLE_FRACTION:
            continue
        if gone[line, column].mean() >= _MIN_GONE_FRACTION:
            out.append(PhotoObjectObservation(thing.position, "absent", share))
        elif (told.found.agrees & ~hidden)[line, column].mean() >= _MIN_SEEN_FRACTION:
            out.append(PhotoObjectObservation(thing.position, "seen", share))
    return out


def _points(
    thing: MapObject, graph_of: Callable[[str], SceneGraph | None], poses: Mapping[str, Sim3]
) -> np.ndarray | None:
    """Return surface samples (K, 3) of an object, in the map frame, from the newest scene that shows the object."""
    for sighting in reversed(thing.sightings):
        if sighting.state != "seen" or sighting.thing < 0:
            continue
        graph = graph_of(sighting.scene)
        if graph is None or graph.segments is None or sighting.scene not in poses:
            return None
        mine = np.repeat(np.arange(len(graph.segments)), graph.segments.sample_counts) == sighting.thing
        return poses[sighting.scene].apply(graph.segments.samples[mine])
    return None


def photo_rows(store: Store) -> list[PhotoRow]:
    """List the stored photos, oldest first, with poses by the newest revision.

    One whose scene has no pose now has neither component nor pose.
    """
    poses, names = store.revisions.poses(), {scene.id: scene.name for scene in store.scenes.list()}
    rows = []
    for photo in store.photos.list():
        one = photo.sighting
        placed = poses.get(one.scene)
        pose, known = None, None
        if placed is not None:
            S = placed.S_map_scene
            pose = transform_poses(one.T_scene_camera, S)
            unit = np.r_[np.ones(3), np.full(3, S.scale)]
            known = one.covariance * np.outer(unit, unit)
        rows.append(
            PhotoRow(
                id=f"p{photo.number}",
                file=one.name,
                digest=one.digest,
                captured_at=one.captured_at,
                component=None if placed is None else placed.component,
                T_map_camera=pose,
                covariance=known,
                intrinsics_px=one.intrinsics_px,
                size_px=one.size_px,
                probability=one.probability,
                scene=one.scene,
                scene_name=names[one.scene],
                num_seen=sum(thing.state == "seen" for thing in one.things),
                num_absent=sum(thing.state == "absent" for thing in one.things),
                added_at=photo.created_at,
            )
        )
    return rows

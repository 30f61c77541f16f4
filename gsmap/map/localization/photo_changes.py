"""Compare localized photos with the map: rows, affected objects, and annotated images."""

from __future__ import annotations

import os
from functools import partial
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from gsmap.durable import make_folder, write_whole
from gsmap.errors import NotFoundError
from gsmap.localize import ChangedRegion, compare_photo
from gsmap.localize.localization import scale_photo
from gsmap.localize.refinement import MAX_SCENES
from gsmap.map.localization.localize import Localizer
from gsmap.map.localization.photos import PhotoObservation, objects_in_photo
from gsmap.map.objects.map_objects import MapObjects, compute_objects
from gsmap.methods import text_digest
from gsmap.types import MapObject, SceneGraph
from gsmap.types.localization import LocalizationResult, Photo
from gsmap.types.localized_photo import PhotoObjectObservation
from gsmap.types.progress import StageProgress
from gsmap.types.rows.localize import LocalizeRow, PhotoChangeRow

_NEAR_M = 0.3  # of an object's box, for a part of a photo to concern it
_COLOURS = {"appeared": (30, 160, 60), "disappeared": (215, 50, 40), "recoloured": (150, 60, 200)}
_OTHER = (235, 140, 20)


class PhotoReporter:
    """Compares localized photos with the map, and loads objects and reference views on first use."""

    def __init__(self, localizer: Localizer, progress: StageProgress) -> None:
        self._localizer, self._progress = localizer, progress
        self._known: MapObjects | None = None
        self._asked = False
        self._graphs: dict[str, SceneGraph | None] = {}

    @property
    def known(self) -> MapObjects | None:
        """Objects of the map; None if they cannot be computed."""
        if not self._asked:
            self._asked = True
            held = self._localizer
            try:
                self._known = compute_objects(held.store, held.settings, self._progress)
            except NotFoundError:
                self._known = None
        return self._known

    def compare(self, photo: Photo, where: LocalizationResult) -> PhotoObservation:
        """Compare a localized photo with the map."""
        assert where.T_map_camera is not None
        assert where.covariance is not None
        assert where.intrinsics_px is not None
        assert where.component is not None
        held = self._localizer
        unit = held.metres.get(where.component, 1.0)
        pose = where.T_map_camera.copy()
        pose[:3, 3] *= unit
        in_metres = np.r_[np.ones(3), np.full(3, unit)]
        support = [held.placed[scene] for scene in where.scenes[:MAX_SCENES]]
        found = compare_photo(
            photo,
            pose,
            where.covariance * np.outer(in_metres, in_metres),
            where.intrinsics_px,
            support,
            {one.scene: held.capture_views(one.scene) for one in support},
            held.params.views.image_size_px,
            held.params.min_change_fraction,
        )
        rows = tuple(self._row(region, where.component, unit) for region in found.regions)
        notes = []
        if found.compared_fraction < _LITTLE:
            notes.append(
                f"{photo.name}: only {found.compared_fraction:.0%} of it could be compared: no capture observed the "
                "rest from a similar direction"
            )
        return PhotoObservation(found, rows, tuple(notes))

    def observed_objects(self, row: LocalizeRow, told: PhotoObservation) -> list[PhotoObjectObservation]:
        """Return the objects that a localized photo shows, and those whose absence it shows, in the map frame."""
        if self.known is None or row.component is None:
            return []
        held = self._localizer
        poses = {scene: pose.S_map_scene for scene, pose in held.store.revisions.poses().items()}
        unit = held.metres.get(row.component, 1.0)
        return objects_in_photo(told, row, unit, self.known.objects, self._graph, poses)

    def _graph(self, scene: str) -> SceneGraph | None:
        if scene not in self._graphs:
            self._graphs[scene] = self._localizer.store.graphs.load(scene)
        return self._graphs[scene]

    def _row(self, region: ChangedRegion, component: int, unit: float) -> PhotoChangeRow:
        position = region.point / unit
        thing = nearest_object(self.known, component, position, unit)
        return PhotoChangeRow(
            kind=region.kind,
            box_px=region.box_px,
            share=region.share,
            strength=region.strength,
            position=position,
            object=None if thing is None else thing.id,
            scene=region.scene,
            scene_name=self._localizer.scenes[region.scene].name,
        )


_LITTLE = 0.2


def nearest_object(known: MapObjects | None, component: int, position: np.ndarray, unit: float) -> MapObject | None:
    """Return the present object whose box is nearest to a point; None if no box is near enough."""
    if known is None:
        return None
    best, far = None, _NEAR_M / unit
    for thing in known.objects:
        if thing.component != component or not thing.there:
            continue
        low, high = thing.box
        distance = float(np.linalg.norm(np.maximum(np.maximum(low - position, position - high), 0)))
        # Of two whose boxes hold it, the smaller: what stands on a table is in the table's box, too.
        if distance < far or (distance == far and best is not None and _volume(thing) < _volume(best)):
            best, far = thing, distance
    return best


def _volume(thing: MapObject) -> float:
    return float(np.prod(thing.box[1] - thing.box[0]))


def write_picture(
    folder: str | os.PathLike[str], file: str, photo: Photo, told: PhotoObservation, localizer: Localizer
) -> Path:
    """Write the photo with differences outlined and numbered, and uncomparable parts in grey.

    Returns:
        The file, named by the photo's name and content, so that two of one name do not meet.
    """
    picture, _ = scale_photo(photo, localizer.params.views.image_size_px)
    rgb = picture.rgb.copy()
    dim = ~told.found.compared
    rgb[dim] = 0.25 * rgb[dim] + 0.75 * 0.5 * (rgb[dim].mean(-1, keepdims=True) + 0.35)
    image = Image.fromarray((np.clip(rgb, 0, 1) * 255 + 0.5).astype(np.uint8))
    draw = ImageDraw.Draw(image)
    scale = told.found.scale
    for number, region in enumerate(told.found.regions, start=1):
        colour = _COLOURS.get(region.kind, _OTHER)
        edge = region.mask & ~_shrunk(region.mask)
        for row, column in np.argwhere(edge).tolist():
            draw.point((column, row), fill=colour)
        x0, y0, x1, y1 = (region.box_px * scale[[0, 1, 0, 1]]).tolist()
        draw.rectangle((x0, y0, max(x1 - 1, x0), max(y1 - 1, y0)), outline=colour, width=2)
        draw.text((x0 + 4, y0 + 2), f"{number} {region.kind}", fill=colour)
    content = BytesIO()
    image.save(content, "PNG")
    root = Path(folder)
    make_folder(root)
    stem = "".join(c if c.isalnum() or c in "-_" else "-" for c in Path(file).stem)[:60] or "photo"
    path = root / f"{stem}-{text_digest(file + photo.rgb[::16, ::16].tobytes().hex())[:8]}.png"
    write_whole(path, partial(_put, content.getvalue()))
    return path


def _put(content: bytes, path: Path) -> None:
    path.write_bytes(content)


def _shrunk(mask: np.ndarray) -> np.ndarray:
    out = mask.copy()
    for axis in (0, 1):
        for step in (1, -1):
            out &= np.roll(mask, step, axis)
    return out

"""Merge one tile from scenes that are read in pieces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from gsmap.errors import InputError
from gsmap.geometry.boxes import inside, moved_box
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.merge import checked_params, merge, merger
from gsmap.merge.overlap import boxes_overlap
from gsmap.merge.reference_view_cache import (
    PlacedReferenceViews,
    ReferenceViewCache,
    RegionCache,
    SceneReferenceViews,
    keys_of,
)
from gsmap.types import Cameras, Gaussians, MergeResult, PosedScene, ReferencePhoto, Sim3
from gsmap.types.merging import UnchangedPlace
from gsmap.types.progress import Progress


@dataclass(frozen=True, eq=False)
class LazyScene:
    """A placed scene that can be read in pieces.

    Args:
        scene_id: id of the scene.
        S_map_scene: pose of the scene.
        load: function that loads at least the Gaussians with means in a box (2, 3) of the scene frame; all for None.
        cameras: cameras of the scene, in the scene's frame.
        captured_at: ISO 8601 time with zone, or None.
        store: cache of the scene's reference views, shared with further tiles.
        without: digest of the Gaussians that ``load`` leaves out; empty for none.
        load_within: as ``load``, but it may omit Gaussians outside of the box if that is cheaper.
        photos: kept photos of the scene, in the scene's frame and unit.
        unchanged: as in `PosedScene`, in the map frame.
    """

    scene_id: str
    S_map_scene: Sim3
    load: Callable[[np.ndarray | None], Gaussians]
    cameras: Cameras | None = None
    captured_at: str | None = None
    store: ReferenceViewCache = field(default_factory=ReferenceViewCache)
    without: str = ""
    load_within: Callable[[np.ndarray], Gaussians] | None = None
    photos: tuple[ReferencePhoto, ...] = ()
    unchanged: tuple[UnchangedPlace, ...] = ()

    def centroid(self) -> np.ndarray | None:
        """(3,) mean of all means of the scene in the map frame; None if the scene is empty."""
        means = self.load(None).means
        return self.S_map_scene.apply(means.mean(0, dtype=np.float64)) if len(means) else None


def merge_tile(
    scenes: Sequence[LazyScene],
    method: str = "tto",
    params: Any = None,
    *,
    bounds: np.ndarray | None = None,
    budget_s: float | None = None,
    progress: Progress | None = None,
) -> MergeResult:
    """Read the surroundings of a tile, transform them to the map frame and merge them; see `gsmap.merge.merge`.

    Memory is bounded by the Gaussians within the merger's ``reading_m`` of the tile and those around one camera of one
    scene. ``origin`` of the result indexes ``scenes``.
    """
    if not scenes:
        raise InputError("nothing to merge: no scene touches the tile", code="nothing_to_merge")
    how, params = merger(method), checked_params(method, params)
    dated = len({scene.captured_at for scene in scenes} - {None}) > 1
    reading = _Reading(
        how.reach_m(params), how.reading_m(params, dated), how.looking_m(params), how.min_cameras(params)
    )
    placed = [_read(scene, bounds, reading) for scene in scenes]
    result = merge(placed, method, params, bounds=bounds, budget_s=budget_s, progress=progress)
    return replace(result, notes=(*result.notes, *_undated(placed))) if how.uses_dates(params) else result


def _undated(placed: Sequence[PosedScene]) -> list[str]:
    """Return a note if overlapping scenes have no date."""
    if all(scene.captured_at is not None for scene in placed):
        return []
    meeting = [scene for scene in placed if any(scene is not other and boxes_overlap(scene, other) for other in placed)]
    count = sum(scene.captured_at is None for scene in meeting)
    if not count:
        return []
    return [
        f"{count} of {len(meeting)} overlapping captures have no date, so their order is unknown; "
        "set dates with gsmap edit MAP SCENE --captured-at DATE"
    ]


@dataclass(frozen=True)
class _Reading:
    """Distances and counts that a merger requires of every scene; see `gsmap.methods.merger.Merger`."""

    reach_m: float
    reading_m: float
    looking_m: float
    min_cameras: int


def _read(scene: LazyScene, bounds: np.ndarray | None, reading: _Reading) -> PosedScene:
    S = scene.S_map_scene
    cameras = None if scene.cameras is None else transform_cameras(scene.cameras, S)
    if bounds is None:
        photos = tuple(_placed(photo, S) for photo in scene.photos)
        whole = transform_gaussians(scene.load(None), S)
        return PosedScene(whole, cameras, scene.scene_id, scene.captured_at, photos=photos, unchanged=scene.unchanged)
    around_m = reading.looking_m + reading.reach_m + float((bounds[1] - bounds[0]).max())
    box = np.array([bounds[0] - reading.reading_m, bounds[1] + reading.reading_m])
    rows = None
    if cameras is not None:
        near = np.array([bounds[0] - reading.looking_m, bounds[1] + reading.looking_m])
        around = _with_cameras(near, cameras.centers, reading.min_cameras)
        found = np.flatnonzero(inside(cameras.centers, around))
        cameras = cameras[found]
        if inside(cameras.centers, near).all() and reading.looking_m > 0:
            rows = found
        if rows is None or reading.reading_m > reading.reach_m:  # views are rendered from these additional Gaussians
            box = np.array([np.minimum(box[0], around[0]), np.maximum(box[1], around[1])])
    read = (scene.load_within or scene.load)(_box_in(S.inverse(), box))
    inner = inside(S.apply(read.means).astype(np.float32), box)
    read = read if inner.all() else read[inner]
    reference_views = None
    if rows is not None:
        reference_views = partial(_reference_views, scene, around_m, rows, keys_of(read.means))
    moved = transform_gaussians(read, S)
    place = RegionCache(lambda near: transform_gaussians(scene.load(near), S), around_m / S.scale)
    photos = tuple(replace(_placed(p, S), around=partial(place.of, p.camera.centers[0])) for p in scene.photos)
    return PosedScene(
        moved, cameras, scene.scene_id, scene.captured_at, scene.centroid, reference_views, photos, scene.unchanged
    )


def _placed(photo: ReferencePhoto, S: Sim3) -> ReferencePhoto:
    return replace(photo, camera=transform_cameras(photo.camera, S), sigma_m=photo.sigma_m * S.scale)


def _reference_views(
    scene: LazyScene, around_m: float, rows: np.ndarray, keys: np.ndarray, longest_side_px: int
) -> PlacedReferenceViews:
    assert scene.cameras is not None
    around = around_m / scene.S_map_scene.scale
    reference_views = SceneReferenceViews(
        scene.scene_id + scene.without, scene.load, scene.cameras, around, longest_side_px, scene.store
    )
    return PlacedReferenceViews(reference_views, scene.S_map_scene, rows, *np.unique(keys, return_inverse=True))


def _with_cameras(box: np.ndarray, centers: np.ndarray, count: int) -> np.ndarray:
    """Enlarge a box so that it contains at least the nearest few cameras.

    A box is convex, so nothing outside of it occludes the tile from a camera inside it; the piece of the scene in the
    box suffices.
    """
    distance = np.linalg.norm(np.maximum(np.maximum(box[0] - centers, centers - box[1]), 0), axis=1)
    nearest = centers[np.argsort(distance, kind="stable")[:count]]
    if len(nearest) == 0:
        return box
    return np.array([np.minimum(box[0], nearest.min(0) - 1e-6), np.maximum(box[1], nearest.max(0) + 1e-6)])


def _box_in(S_b_a: Sim3, box: np.ndarray) -> np.ndarray:
    """Return the axis-aligned box (2, 3) in frame b around a box of frame a, enlarged against rounding errors."""
    moved = moved_box(box, S_b_a)
    pad = 1e-5 * (1 + np.abs(moved).max())
    return np.array([moved[0] - pad, moved[1] + pad])

"""Merging one tile of a map from scenes that are read piece by piece."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmap.errors import InputError
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.merge import MergeResult, Part, merge, reading_m
from gsmap.merge.parts import inside
from gsmap.types import Cameras, Gaussians, Sim3

# A tile that no camera stands in or near is refined from the nearest ones, wherever they stand.
_MIN_CAMERAS = 12


@dataclass(frozen=True, eq=False)
class Source:
    """A placed scene that can be read in pieces.

    Args:
        scene_id: which scene.
        S_map_scene: where it lies.
        load: the Gaussians whose means lie in a box (2, 3) of the scene's frame, or more of them; all for None.
        cameras: its cameras, scene frame.
        captured_at: ISO 8601 time with zone, or None.
    """

    scene_id: str
    S_map_scene: Sim3
    load: Callable[[np.ndarray | None], Gaussians]
    cameras: Cameras | None = None
    captured_at: str | None = None


def merge_tile(
    sources: Sequence[Source],
    method: str = "tto",
    params: object | None = None,
    *,
    bounds: np.ndarray | None = None,
    budget_s: float | None = None,
    progress: Callable[[float, str], None] | None = None,
) -> MergeResult:
    """Read what lies around a tile, bring it to the map frame and merge it; see `gsmap.merge.merge`.

    Memory is bounded by what lies within `reading_m` of the tile. ``origin`` of the result counts in ``sources``.
    """
    if not sources:
        raise InputError("nothing to merge: no scene touches the tile")
    reach = reading_m(method, params)
    parts = [_read(source, bounds, reach) for source in sources]
    if method == "distance" and bounds is not None:
        parts = [replace(part, centroid=_centroid(source)) for part, source in zip(parts, sources, strict=True)]
    return merge(parts, method, params, bounds=bounds, budget_s=budget_s, progress=progress)


def _read(source: Source, bounds: np.ndarray | None, reach: float) -> Part:
    S = source.S_map_scene
    cameras = None if source.cameras is None else transform_cameras(source.cameras, S)
    if bounds is None:
        return Part(transform_gaussians(source.load(None), S), cameras, source.scene_id, source.captured_at)
    box = np.array([bounds[0] - reach, bounds[1] + reach])
    if cameras is not None and reach > 0:
        box = _with_cameras(box, cameras.centers)
        cameras = cameras[inside(cameras.centers, box)]
    gaussians = transform_gaussians(source.load(_box_in(S.inverse(), box)), S)
    return Part(gaussians[inside(gaussians.means, box)], cameras, source.scene_id, source.captured_at)


def _with_cameras(box: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """The box, grown to hold at least the nearest few cameras.

    A box is convex: what a camera inside it sees of the tile is hidden by nothing outside it, so pieces suffice.
    """
    distance = np.linalg.norm(np.maximum(np.maximum(box[0] - centers, centers - box[1]), 0), axis=1)
    nearest = centers[np.argsort(distance, kind="stable")[:_MIN_CAMERAS]]
    if len(nearest) == 0:
        return box
    return np.array([np.minimum(box[0], nearest.min(0) - 1e-6), np.maximum(box[1], nearest.max(0) + 1e-6)])


def _box_in(S_b_a: Sim3, box: np.ndarray) -> np.ndarray:
    """The axis-aligned box (2, 3) in frame b around a box of frame a, a touch larger against rounding."""
    corners = np.array([[box[i, 0], box[j, 1], box[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    moved = S_b_a.apply(corners)
    pad = 1e-5 * (1 + np.abs(moved).max())
    return np.array([moved.min(0) - pad, moved.max(0) + pad])


def _centroid(source: Source) -> np.ndarray:
    return source.S_map_scene.apply(source.load(None).means.mean(0, dtype=np.float64))

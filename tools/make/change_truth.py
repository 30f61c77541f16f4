"""What tools/make/change.py wrote, read back: captures, views at all times, and what two captures saw of a change.

All is in the place's frame, in metres.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gsmap import formats
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.types import Cameras, Gaussians, Sim3
from gsmap_synthetic.change import true_changes

VOXEL_M = 0.1
_SEEN_M = 0.05  # so far before a surface counts as seen; half a voxel
_MIN_POINTS = 2  # in a voxel, of pixels thinned to 2.5 cm


@dataclass(frozen=True, eq=False)
class Views:
    """What all cameras of one capture look at, at one time: ids (C, H, W) and depths (C, H, W), 0 for nothing."""

    ids: np.ndarray
    depths_m: np.ndarray


@dataclass(eq=False)
class Truth:
    """The folder of one place of tools/make/change.py, read as it is asked for."""

    folder: Path
    _views: dict[tuple[str, str], Views] = field(default_factory=dict)
    _clouds: dict[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)

    @cached_property
    def times(self) -> list[str]:
        """Names of the captures, oldest first."""
        return list(json.loads((self.folder / "truth" / "changes.json").read_text())["times"])

    @cached_property
    def _facts(self) -> dict[str, dict[str, Any]]:
        return {t: json.loads((self.folder / "truth" / f"{t}.json").read_text()) for t in self.times}

    def states(self, time: str) -> list[dict[str, Any]]:
        """See `gsmap_synthetic.change.states`."""
        return self._facts[time]["objects"]

    def T_place_scene(self, time: str) -> Sim3:
        """From a capture's frame to the place's."""
        return Sim3.from_matrix(np.array(self._facts[time]["T_scene_world"])).inverse()

    def gaussians(self, time: str) -> Gaussians:
        """A capture's Gaussians, place frame."""
        return transform_gaussians(formats.read(self.folder / f"{time}.ply"), self.T_place_scene(time))

    def cameras(self, time: str) -> Cameras:
        """A capture's cameras, place frame."""
        cameras = formats.read_cameras(self.folder / f"{time}.cameras.json")
        return transform_cameras(cameras, self.T_place_scene(time))

    def captured_at(self, time: str) -> str:
        """ISO 8601."""
        return str(self._facts[time]["captured_at"])

    def held_out(self, time: str) -> np.ndarray:
        """(C,) bool, which cameras of a capture it was not trained on."""
        return np.isin(self.cameras(time).names, self._facts[time]["held_out"])

    def photographs(self, time: str) -> np.ndarray:
        """(C, H, W, 3) float32 in [0, 1]."""
        names = self.cameras(time).names
        pictures = [np.asarray(Image.open(self.folder / "frames" / f"{name}.jpg")) for name in names]
        return np.stack(pictures) / np.float32(255)

    def views(self, time: str, of: str | None = None) -> Views:
        """What the cameras of a capture would have seen at the time ``of`` (by default their own)."""
        key = time, of or time
        if key not in self._views:
            files = [np.load(self.folder / "truth" / "masks" / f"{name}.npz") for name in self.cameras(time).names]
            ids = np.stack([f[f"ids_{key[1]}"] for f in files])
            self._views[key] = Views(ids, np.stack([f[f"depth_mm_{key[1]}"] for f in files]) / np.float32(1000))
        return self._views[key]

    def changes(self, before: str, after: str) -> list[dict[str, Any]]:
        """See `gsmap_synthetic.change.true_changes`."""
        return true_changes(self.states(before), self.states(after))


# --- what was seen ----------------------------------------------------------------------------------------------------


def observed(truth: Truth, time: str, points: np.ndarray) -> np.ndarray:
    """(n,) whether a capture looked at points or through them, in the frames that it was trained on."""
    views, seen, held = truth.views(time), np.zeros(len(points), bool), truth.held_out(time)
    for row, pixels, depth in projected(truth.cameras(time), points):
        if held[row]:
            continue
        at = views.depths_m[row][pixels[:, 1], pixels[:, 0]]
        seen |= (depth > 0.05) & (depth < at + _SEEN_M) & (pixels >= 0).all(1)
    return seen


def looked_through(truth: Truth, time: str, points: np.ndarray) -> np.ndarray:
    """(n,) whether a capture saw a surface clearly behind points, and none at them."""
    views = truth.views(time)
    through, on = np.zeros(len(points), bool), np.zeros(len(points), bool)
    for row, pixels, depth in projected(truth.cameras(time), points):
        gap = views.depths_m[row][pixels[:, 1], pixels[:, 0]] - depth
        inside = (pixels >= 0).all(1)
        through |= inside & (gap > 2 * _SEEN_M)
        on |= inside & (np.abs(gap) < _SEEN_M)
    return through & ~on


def owners(truth: Truth, time: str, points: np.ndarray) -> np.ndarray:
    """(n,) ids of the objects that points of a capture (its Gaussians' means, say) lie on, by its own views."""
    views = truth.views(time)
    votes = np.zeros((len(points), max(s["id"] for s in truth.states(time)) + 1), np.uint16)
    for row, pixels, depth in projected(truth.cameras(time), points):
        ids = views.ids[row][pixels[:, 1], pixels[:, 0]]
        on = np.abs(depth - views.depths_m[row][pixels[:, 1], pixels[:, 0]]) < _SEEN_M
        rows = np.flatnonzero(on & (ids >= 0) & (pixels >= 0).all(1))
        votes[rows, ids[rows]] += 1
    return np.where(votes.any(1), votes.argmax(1), -1)


def projected(cameras: Cameras, points: np.ndarray) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """For each camera its row, the pixels (n, 2) that points fall on, -1 where outside, and their depths (n,)."""
    for row in range(len(cameras)):
        T = np.linalg.inv(cameras.T_frame_camera[row])
        local = points @ T[:3, :3].T + T[:3, 3]
        depth = local[:, 2]
        fx, fy, cx, cy = cameras.intrinsics_px[row]
        with np.errstate(divide="ignore", invalid="ignore"):
            at = np.stack([fx * local[:, 0] / depth + cx, fy * local[:, 1] / depth + cy], axis=1)
        inside = (depth > 0.05) & (at >= 0).all(1) & (at < cameras.sizes_px[row]).all(1)
        yield row, np.where(inside[:, None], at, -1).astype(np.int64), depth


def changed_voxels(truth: Truth, before: str, after: str) -> list[tuple[dict[str, Any], np.ndarray]]:
    """Each true change and the centres (n, 3) of the voxels of `VOXEL_M` where both captures could see it.

    The surfaces it had as the older capture saw them where the newer looked, and those it has as the newer sees them
    where the older looked.
    """
    out = []
    clouds = {time: _cloud(truth, time) for time in (before, after)}
    changes = truth.changes(before, after)
    for change in changes:
        parts = []
        for time, key, other in ((before, "before", after), (after, "after", before)):
            points, ids = clouds[time]
            own = points[ids == change[key]] if change[key] is not None else points[:0]
            parts.append(own[observed(truth, other, own)])
        cells, counts = np.unique(np.floor(np.concatenate(parts) / VOXEL_M), axis=0, return_counts=True)
        out.append((change, (cells[counts >= _MIN_POINTS] + 0.5) * VOXEL_M))
    return out


def _cloud(truth: Truth, time: str) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) that a capture saw, thinned to 2.5 cm, and the ids of their objects."""
    if time not in truth._clouds:
        views, cameras = truth.views(time), truth.cameras(time)
        height, width = views.ids.shape[1:]
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        points, ids = [], []
        for row in range(len(cameras)):
            fx, fy, cx, cy = cameras.intrinsics_px[row]
            depth = views.depths_m[row]
            local = np.stack([(x - cx) / fx * depth, (y - cy) / fy * depth, depth], axis=-1)[depth > 0]
            T = cameras.T_frame_camera[row]
            cloud, owner = _thinned(local @ T[:3, :3].T + T[:3, 3], views.ids[row][depth > 0])
            points.append(cloud)
            ids.append(owner)
        truth._clouds[time] = _thinned(np.concatenate(points), np.concatenate(ids))
    return truth._clouds[time]


def _thinned(points: np.ndarray, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One point of each object in each cube of 2.5 cm."""
    cells = np.floor(points / 0.025).astype(np.int64) + (1 << 15)
    keys = ((cells[:, 0] << 48) | (cells[:, 1] << 32) | (cells[:, 2] << 16)) + ids
    _, first = np.unique(keys, return_index=True)
    return points[first], ids[first]

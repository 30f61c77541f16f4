"""Cache of reference views: renders of a scene's own views, shared by all tiles that appear in them.

A view is rendered in the scene's own frame, from the Gaussians around its camera rather than around a tile. So it does
not depend on the tile, or on which tiles are computed together.
"""

from __future__ import annotations

import math
import os
import secrets
from collections import Counter, OrderedDict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Generic, TypeVar

import numpy as np

from gsmap.geometry.boxes import inside, moved_box
from gsmap.methods import text_digest
from gsmap.render import ChunkIndex, render
from gsmap.types import Cameras, Gaussians, Sim3

_CAN_BE_HELD = 256 << 20
"""Size in bytes of the reference views that a process without a cache folder keeps in memory."""

_CELL = 0.25
"""Edge of the cells by which cameras are grouped, so that the surroundings of a cell are read once; relative to the
radius of\nthe surroundings."""


_KINDS = (np.float64, np.uint64, np.int32, np.float32, np.float32)  # types of the arrays of a view


@dataclass(frozen=True, eq=False)
class ReferenceView:
    """Visibility data of one view of a scene, in the scene's frame and unit.

    Args:
        box: (2, 3) lowest and highest corner of the visible surface.
        keys: (K,) uint64 sorted distinct keys of the visible Gaussians, from `keys_of`.
        pixels: (K,) int32 number of pixels that each visible Gaussian dominates.
        largest: (K,) float32 largest blending weight of each visible Gaussian.
        depth: (H, W) float32 expected z of the surface, 0 without a surface.
    """

    box: np.ndarray
    keys: np.ndarray
    pixels: np.ndarray
    largest: np.ndarray
    depth: np.ndarray

    @cached_property
    def num_bytes(self) -> int:
        return sum(array.nbytes for array in self._arrays())

    def _arrays(self) -> tuple[np.ndarray, ...]:
        return self.box, self.keys, self.pixels, self.largest, self.depth

    def write(self, path: Path) -> None:
        """Write the view to a file atomically."""
        sizes = np.array([len(self.keys), *self.depth.shape], dtype="<i8")
        with NamedTemporaryFile(dir=path.parent, prefix=".", delete=False) as file:
            file.write(sizes.tobytes())
            for kind, array in zip(_KINDS, self._arrays(), strict=True):
                file.write(np.ascontiguousarray(array, kind).data)
        os.replace(file.name, path)

    @classmethod
    def read(cls, path: Path) -> ReferenceView:
        """Read a view from a file.

        Raises:
            OSError, ValueError: the file is missing, or truncated.
        """
        # Raw arrays in sequence: a tile reads hundreds of views, and parsing headers would take longer.
        content = path.read_bytes()
        shown, height, width = np.frombuffer(content, "<i8", 3).tolist()
        parts, at = [], 24
        for kind, shape in zip(_KINDS, ((2, 3), (shown,), (shown,), (shown,), (height, width)), strict=True):
            parts.append(np.frombuffer(content, kind, math.prod(shape), at).reshape(shape))
            at += parts[-1].nbytes
        if at != len(content):
            raise ValueError(f"{path} is truncated")
        return cls(*parts)


@dataclass(frozen=True)
class ReferenceViewCache:
    """Cache of the reference views of one run while tiles are computed.

    Args:
        folder: folder of files that the processes of one run share; if its parent does not exist, a few views are kept
            in memory instead.
        max_bytes: largest total size of the files; the oldest files are deleted first.
    """

    folder: str = field(default_factory=lambda: f"/nowhere/{secrets.token_hex(16)}")
    max_bytes: int = 4 << 30

    def get(self, name: str, make: Callable[[], ReferenceView]) -> ReferenceView:
        """Return the view with a name; call ``make`` if the view is not in the cache."""
        folder = Path(self.folder)
        if not folder.parent.is_dir():
            return self._held(name, make)
        with suppress(OSError, ValueError):
            return ReferenceView.read(folder / name)
        made = make()
        with suppress(OSError):  # with a full disk the view is computed again for the next tile
            folder.mkdir(exist_ok=True)
            made.write(folder / name)
            self._make_room(made.num_bytes)
        return made

    def _held(self, name: str, make: Callable[[], ReferenceView]) -> ReferenceView:
        at = (self.folder, name)
        found = make() if at not in _HELD else _HELD.pop(at)
        _HELD[at] = found  # the newest view is last
        while len(_HELD) > 1 and sum(view.num_bytes for view in _HELD.values()) > _CAN_BE_HELD:
            _HELD.popitem(last=False)
        return found

    def _make_room(self, num_bytes: int) -> None:
        """Delete the oldest files if all files together are too large; the size is tested once per sixteenth of the
        limit."""
        _WRITTEN[self.folder] += num_bytes
        if _WRITTEN[self.folder] < self.max_bytes / 16:
            return
        _WRITTEN[self.folder] = 0
        with os.scandir(self.folder) as found:
            files = sorted((stat.st_mtime_ns, stat.st_size, one.path) for one in found for stat in [one.stat()])
        over = sum(size for _, size, _ in files) - self.max_bytes
        for _, size, path in files:
            if over <= 0:
                return
            with suppress(FileNotFoundError):
                os.unlink(path)
            over -= size


_HELD: OrderedDict[tuple[str, str], ReferenceView] = OrderedDict()
_WRITTEN: Counter[str] = Counter()  # bytes written to each folder since its size was last tested


T = TypeVar("T")


@dataclass(eq=False)
class RegionCache(Generic[T]):
    """Data of the surroundings of cameras, computed once per cell of cameras; the data of the last cell are cached.

    Args:
        make: function that returns the data of at least a box (2, 3).
        around: smallest distance from a camera to each side of its box, in the unit of the box.
    """

    make: Callable[[np.ndarray], T]
    around: float
    _last: tuple[tuple[int, ...], T] | None = None

    def cell(self, centre: np.ndarray) -> tuple[int, ...]:
        """Return the cell of a camera centre (3,)."""
        return tuple(int(v) for v in np.floor(centre / (_CELL * self.around)))

    def of(self, centre: np.ndarray) -> T:
        """Return the data of the surroundings of a camera centre (3,)."""
        cell = self.cell(centre)
        if self._last is None or self._last[0] != cell:
            self._last = None  # freed first, so that data of two cells are never in memory
            low = np.array(cell) * _CELL * self.around
            self._last = cell, self.make(np.array([low - self.around, low + (1 + _CELL) * self.around]))
        return self._last[1]


@dataclass(eq=False)
class SceneReferenceViews:
    """The reference views of one scene.

    Args:
        scene_id: id of the scene.
        load: function that loads at least the Gaussians with means in a box (2, 3) of the scene frame.
        cameras: all cameras of the scene, in the scene's frame.
        around: Gaussians within at least this distance along each axis from a camera are rendered, in the scene's unit.
        longest_side_px: longest side of the views.
        store: cache of the views.
    """

    scene_id: str
    load: Callable[[np.ndarray | None], Gaussians]
    cameras: Cameras
    around: float
    longest_side_px: int
    store: ReferenceViewCache

    @cached_property
    def _nearby(self) -> RegionCache[tuple[Gaussians, ChunkIndex, np.ndarray, np.ndarray]]:
        return RegionCache(self._with_keys, self.around)

    def of(self, camera: int) -> ReferenceView:
        """Return the view of a camera."""
        about = (self.scene_id, camera, self.longest_side_px, repr(self.around))
        return self.store.get(text_digest(" ".join(map(str, about)))[:32], lambda: self._seen(camera))

    def cell(self, camera: int) -> tuple[int, ...]:
        """Return the cell of a camera; it is best to process the cameras of one cell in sequence."""
        return self._nearby.cell(self.cameras.centers[camera])

    def _seen(self, camera: int) -> ReferenceView:
        gaussians, index, keys, order = self._nearby.of(self.cameras.centers[camera])
        view = self.cameras[camera].resized(self.longest_side_px)
        seen = render(gaussians, view, max_weight=True, index=index)
        dominant = seen.dominant_id[0]
        pixels = np.bincount(dominant[dominant >= 0], minlength=len(gaussians))
        shown = (seen.max_weight > 0)[order]
        rows, keys = order[shown], keys[shown]
        if len(keys):
            first = np.append(True, keys[1:] != keys[:-1])  # of Gaussians with equal means
            rows, keys = rows[first], keys[first]
        depth = np.ascontiguousarray(seen.depth[0])
        return ReferenceView(_box_of(view, depth), keys, pixels[rows].astype(np.int32), seen.max_weight[rows], depth)

    def _with_keys(self, box: np.ndarray) -> tuple[Gaussians, ChunkIndex, np.ndarray, np.ndarray]:
        """Return the Gaussians in a box without view-dependent colour, which views do not keep, their index, their
        sorted keys, and the permutation that sorts them."""
        found = self.load(box)
        found = found.degree_0(inside(found.means, box))
        keys = keys_of(found.means)
        order = np.argsort(keys, kind="stable")
        return found, ChunkIndex.build(found), keys[order], order


@dataclass(frozen=True, eq=False)
class PlacedReferenceViews:
    """The reference views of a placed scene, for the piece of the scene that a tile reads.

    Args:
        views: reference views of the scene.
        S_map_scene: pose of the scene.
        rows: (C,) index in the scene of each placed camera.
        keys: (K,) uint64 sorted distinct keys of the placed Gaussians.
        key_of: (N,) index of the key of each placed Gaussian.
    """

    views: SceneReferenceViews
    S_map_scene: Sim3
    rows: np.ndarray
    keys: np.ndarray
    key_of: np.ndarray

    def of(self, camera: int) -> ReferenceView:
        """Return the view of a placed camera, in the frame of the scene."""
        return self.views.of(int(self.rows[camera]))

    def cell(self, camera: int) -> tuple[int, ...]:
        """Return the cell of a placed camera."""
        return self.views.cell(int(self.rows[camera]))

    def depth(self, view: ReferenceView) -> np.ndarray:
        """Return the depth image (H, W) of a view, in the map's unit."""
        found: np.ndarray = view.depth * np.float32(self.S_map_scene.scale)
        return found

    def touches(self, view: ReferenceView, bounds: np.ndarray | None, margin: float) -> bool:
        """Return whether the surface in a view may reach into the map bounds (2, 3), enlarged by a margin."""
        if bounds is None:
            return True
        if not np.isfinite(view.box).all():
            return False
        low, high = moved_box(view.box, self.S_map_scene)
        return bool((low <= bounds[1] + margin).all() and (high >= bounds[0] - margin).all())

    def count(self, view: ReferenceView, pixels: np.ndarray, largest: np.ndarray) -> None:
        """Add the pixels and the largest weights of the placed Gaussians in a view to the (K,) arrays by key."""
        if not len(self.keys):
            return
        at = np.minimum(np.searchsorted(self.keys, view.keys), len(self.keys) - 1)
        known = self.keys[at] == view.keys
        at = at[known]
        pixels[at] += view.pixels[known]
        largest[at] = np.maximum(largest[at], view.largest[known])


def keys_of(means: np.ndarray) -> np.ndarray:
    """Return (N,) uint64 keys of the Gaussians of one scene: hashes of their means, which do not depend on the piece
    that is read."""
    bits = np.ascontiguousarray(means, dtype=np.float32).view(np.uint32).astype(np.uint64)
    mixed: np.ndarray = bits[:, 0] * np.uint64(0x9E3779B97F4A7C15)
    for axis in (1, 2):
        mixed = (mixed ^ (mixed >> np.uint64(29)) ^ bits[:, axis]) * np.uint64(0xBF58476D1CE4E5B9)
    return mixed


def _box_of(view: Cameras, depth: np.ndarray) -> np.ndarray:
    """Return the (2, 3) box around the surface of a depth image; empty (low above high) without a surface."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    shown = depth > 0
    if not shown.any():
        return np.array([high, low])
    for axis, along in enumerate(surface_axes(view, depth)):
        values = along[shown]
        low[axis], high[axis] = values.min(), values.max()
    return np.array([low, high])


def surface_axes(camera: Cameras, depth: np.ndarray, step: int = 1) -> list[np.ndarray]:
    """Return x, y and z, each (H, W) float32, of the points of a depth image in the frame of the camera's pose; with a
    ``step`` those of its pixels ``[::step, ::step]``."""
    height, width = depth.shape
    fx, fy, cx, cy = camera.intrinsics_px[0]
    x = (np.arange(0, width, step) + 0.5 - cx) / fx
    y = (np.arange(0, height, step) + 0.5 - cy) / fy
    depth = depth[::step, ::step]
    T = camera.T_frame_camera[0]
    axes = []
    for axis in range(3):
        along = (T[axis, 0] * x + T[axis, 2]).astype(np.float32)[None, :]
        ray = along + (T[axis, 1] * y).astype(np.float32)[:, None]
        ray *= depth
        ray += np.float32(T[axis, 3])
        axes.append(ray)
    return axes

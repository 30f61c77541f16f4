"""What the views of a capture show, rendered once and shared by all tiles that they show something of.

A view is rendered in the capture's own frame, from what lies around the place that its camera stands in: not from what
lies around a tile. So what it shows does not depend on the tile that asks, nor on which tiles are made together.
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
from gsmap.render import render
from gsmap.types import Cameras, Gaussians, Sim3

_CAN_BE_HELD = 256 << 20
"""Bytes of sights that a process keeps in memory where it has no folder for them."""

_CELL = 0.25
"""Edge of the cells by which cameras are taken together, so that what is around them is read once for many; as a share
of how far they look."""


_KINDS = (np.float64, np.uint64, np.int32, np.float32, np.float32)  # of the arrays of a sight


@dataclass(frozen=True, eq=False)
class Sight:
    """What one view of a capture shows, in the capture's frame and unit.

    Args:
        box: (2, 3) lowest and highest corner of the surface that it shows.
        keys: (K,) uint64, sorted: the Gaussians that it shows, as `keys_of` names them.
        pixels: (K,) int32 in how many of its pixels each of them dominates.
        largest: (K,) float32 largest weight of each of them in any of its pixels.
        depth: (H, W) float32 expected z of the surface, 0 where there is none.
    """

    box: np.ndarray
    keys: np.ndarray
    pixels: np.ndarray
    largest: np.ndarray
    depth: np.ndarray

    @property
    def num_bytes(self) -> int:
        return sum(array.nbytes for array in self._arrays())

    def _arrays(self) -> tuple[np.ndarray, ...]:
        return self.box, self.keys, self.pixels, self.largest, self.depth

    def write(self, path: Path) -> None:
        """Put a file at the path, whole or not at all."""
        sizes = np.array([len(self.keys), *self.depth.shape], dtype="<i8")
        with NamedTemporaryFile(dir=path.parent, prefix=".", delete=False) as file:
            file.write(sizes.tobytes())
            for kind, array in zip(_KINDS, self._arrays(), strict=True):
                file.write(np.ascontiguousarray(array, kind).data)
        os.replace(file.name, path)

    @classmethod
    def read(cls, path: Path) -> Sight:
        """Raises: OSError, ValueError: it is not there, or not whole."""
        # Bare arrays one after the other: a tile reads hundreds, and headers take longer.
        content = path.read_bytes()
        shown, height, width = np.frombuffer(content, "<i8", 3).tolist()
        parts, at = [], 24
        for kind, shape in zip(_KINDS, ((2, 3), (shown,), (shown,), (shown,), (height, width)), strict=True):
            parts.append(np.frombuffer(content, kind, math.prod(shape), at).reshape(shape))
            at += parts[-1].nbytes
        if at != len(content):
            raise ValueError(f"{path} is not whole")
        return cls(*parts)


@dataclass(frozen=True)
class SightStore:
    """Where the sights of one run are kept while tiles are made.

    Args:
        folder: for files that processes share, a name that no other run uses; where the folder it would lie in is not
            there, a few sights are kept in memory instead.
        max_bytes: that the files may take: those that were made first go first.
    """

    folder: str = field(default_factory=lambda: f"/nowhere/{secrets.token_hex(16)}")
    max_bytes: int = 4 << 30

    def get(self, name: str, make: Callable[[], Sight]) -> Sight:
        """The sight of that name; made where it is not kept."""
        folder = Path(self.folder)
        if not folder.parent.is_dir():
            return self._held(name, make)
        with suppress(OSError, ValueError):
            return Sight.read(folder / name)
        made = make()
        with suppress(OSError):  # a full disk: it is made again for the next tile
            folder.mkdir(exist_ok=True)
            made.write(folder / name)
            self._make_room(made.num_bytes)
        return made

    def _held(self, name: str, make: Callable[[], Sight]) -> Sight:
        at = (self.folder, name)
        found = make() if at not in _HELD else _HELD.pop(at)
        _HELD[at] = found  # the newest last
        while len(_HELD) > 1 and sum(sight.num_bytes for sight in _HELD.values()) > _CAN_BE_HELD:
            _HELD.popitem(last=False)
        return found

    def _make_room(self, num_bytes: int) -> None:
        """Delete the oldest files where all take too much; looked at now and then."""
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


_HELD: OrderedDict[tuple[str, str], Sight] = OrderedDict()
_WRITTEN: Counter[str] = Counter()  # bytes since a folder was last looked at


T = TypeVar("T")


@dataclass(eq=False)
class Nearby(Generic[T]):
    """What lies around cameras, made once for those of one cell; the last place is remembered.

    Args:
        make: of a box (2, 3), what lies in it, or more.
        around: length, in the unit of the box: what lies at least so near to a camera on each axis is in it.
    """

    make: Callable[[np.ndarray], T]
    around: float
    _last: tuple[tuple[int, ...], T] | None = None

    def cell(self, centre: np.ndarray) -> tuple[int, ...]:
        """By which cameras (3,) are taken together."""
        return tuple(int(v) for v in np.floor(centre / (_CELL * self.around)))

    def of(self, centre: np.ndarray) -> T:
        """What lies around a camera (3,)."""
        cell = self.cell(centre)
        if self._last is None or self._last[0] != cell:
            self._last = None  # two of them need not be held at once
            low = np.array(cell) * _CELL * self.around
            self._last = cell, self.make(np.array([low - self.around, low + (1 + _CELL) * self.around]))
        return self._last[1]


@dataclass(eq=False)
class Sights:
    """The views of one capture.

    Args:
        scene_id: which capture.
        load: its Gaussians whose means lie in a box (2, 3) of its frame, or more of them.
        cameras: all of its cameras, its frame.
        around: length, in its unit: a view shows what lies at least so near its camera on each axis.
        longest_side_px: size of the pictures.
        store: where sights are kept.
    """

    scene_id: str
    load: Callable[[np.ndarray | None], Gaussians]
    cameras: Cameras
    around: float
    longest_side_px: int
    store: SightStore

    @cached_property
    def _nearby(self) -> Nearby[tuple[Gaussians, np.ndarray]]:
        return Nearby(self._with_keys, self.around)

    def of(self, camera: int) -> Sight:
        """What one of the cameras sees."""
        about = (self.scene_id, camera, self.longest_side_px, repr(self.around))
        return self.store.get(text_digest(" ".join(map(str, about)))[:32], lambda: self._seen(camera))

    def cell(self, camera: int) -> tuple[int, ...]:
        """By which cameras are taken together."""
        return self._nearby.cell(self.cameras.centers[camera])

    def _seen(self, camera: int) -> Sight:
        gaussians, keys = self._nearby.of(self.cameras.centers[camera])
        view = self.cameras[camera].resized(self.longest_side_px)
        seen = render(gaussians, view, max_weight=True)
        dominant = seen.dominant_id[0]
        pixels = np.bincount(dominant[dominant >= 0], minlength=len(gaussians))
        rows = np.flatnonzero(seen.max_weight > 0)
        rows = rows[np.argsort(keys[rows], kind="stable")]
        depth = np.ascontiguousarray(seen.depth[0])
        return Sight(_box_of(view, depth), keys[rows], pixels[rows].astype(np.int32), seen.max_weight[rows], depth)

    def _with_keys(self, box: np.ndarray) -> tuple[Gaussians, np.ndarray]:
        found = self.load(box)
        found = found[inside(found.means, box)]
        return found, keys_of(found.means)


@dataclass(frozen=True, eq=False)
class PlacedSights:
    """The sights of a capture that lies in a map, for the piece of it that a tile reads.

    Args:
        sights: of the capture.
        S_map_scene: where it lies.
        rows: (C,) which of its cameras each of the placed ones is.
        keys: (N,) uint64, names of the placed Gaussians.
        order: (N,) that sorts them.
    """

    sights: Sights
    S_map_scene: Sim3
    rows: np.ndarray
    keys: np.ndarray
    order: np.ndarray

    def of(self, camera: int) -> Sight:
        """What one of the placed cameras sees, in the frame of the capture."""
        return self.sights.of(int(self.rows[camera]))

    def cell(self, camera: int) -> tuple[int, ...]:
        """Placed cameras of one are best asked one after the other."""
        return self.sights.cell(int(self.rows[camera]))

    def depth(self, sight: Sight) -> np.ndarray:
        """(H, W) of a sight in the map's unit."""
        found: np.ndarray = sight.depth * np.float32(self.S_map_scene.scale)
        return found

    def touches(self, sight: Sight, bounds: np.ndarray | None, margin: float) -> bool:
        """Whether the surface it shows may reach into bounds (2, 3) of the map grown by a margin."""
        if bounds is None:
            return True
        if not np.isfinite(sight.box).all():
            return False
        low, high = moved_box(sight.box, self.S_map_scene)
        return bool((low <= bounds[1] + margin).all() and (high >= bounds[0] - margin).all())

    def count(self, sight: Sight, pixels: np.ndarray, largest: np.ndarray) -> None:
        """Add to (N,) what the placed Gaussians show in it."""
        if not len(sight.keys):
            return
        # Sorted into sorted: searching at random takes several times as long.
        at = np.minimum(np.searchsorted(sight.keys, self.keys[self.order]), len(sight.keys) - 1)
        known = sight.keys[at] == self.keys[self.order]
        rows, at = self.order[known], at[known]
        pixels[rows] += sight.pixels[at]
        largest[rows] = np.maximum(largest[rows], sight.largest[at])


def keys_of(means: np.ndarray) -> np.ndarray:
    """(N,) uint64 that tell the Gaussians of one capture apart, whatever piece of it is read: mixed bits of (N, 3)."""
    bits = np.ascontiguousarray(means, dtype=np.float32).view(np.uint32).astype(np.uint64)
    mixed: np.ndarray = bits[:, 0] * np.uint64(0x9E3779B97F4A7C15)
    for axis in (1, 2):
        mixed = (mixed ^ (mixed >> np.uint64(29)) ^ bits[:, axis]) * np.uint64(0xBF58476D1CE4E5B9)
    return mixed


def _box_of(view: Cameras, depth: np.ndarray) -> np.ndarray:
    """(2, 3) around the surface that a depth map shows; empty (low above high) where it shows none."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    shown = depth > 0
    if not shown.any():
        return np.array([high, low])
    for axis, along in enumerate(surface_axes(view, depth)):
        values = along[shown]
        low[axis], high[axis] = values.min(), values.max()
    return np.array([low, high])


def surface_axes(camera: Cameras, depth: np.ndarray) -> list[np.ndarray]:
    """Three (H, W) float32: x, y and z of the points of a depth map of one camera, in the camera's frame's parent."""
    height, width = depth.shape
    fx, fy, cx, cy = camera.intrinsics_px[0]
    x = (np.arange(width) + 0.5 - cx) / fx
    y = (np.arange(height) + 0.5 - cy) / fy
    T = camera.T_frame_camera[0]
    axes = []
    for axis in range(3):
        along = (T[axis, 0] * x + T[axis, 2]).astype(np.float32)[None, :]
        ray = along + (T[axis, 1] * y).astype(np.float32)[:, None]
        ray *= depth
        ray += np.float32(T[axis, 3])
        axes.append(ray)
    return axes

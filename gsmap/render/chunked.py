"""Gaussians of which each chunk is read when a camera first sees it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmap.geometry.sh import sh0_of_rgb
from gsmap.render.index import ChunkIndex, join_ranges
from gsmap.types import Cameras, Gaussians
from gsmap.types.gaussians import FIELDS
from gsmap.types.source import ChunkSource

# How far Gaussians are drawn beyond the stored box of their chunk, as the radius of an index relative to the longest
# side of that box. A deviation along an axis is at most a sixth of the side. A footprint reaches MAX_SIGMAS deviations
# instead of the three of the box, and its Jacobian is that of a ray up to 15 % of the image's width outside of it.
_BEYOND_BOX = 0.06
_ROWS = 1024  # Gaussians of a chunk of the fine index; stored chunks are larger


class ChunkedGaussians:
    """Gaussians in arrays of full size, of which only the chunks that were seen are read; other rows are undefined.

    A render of a camera is the same, bit for bit, as one of all Gaussians.
    """

    def __init__(self, source: ChunkSource) -> None:
        self._source = source
        n, boxes = source.num_gaussians, source.boxes
        starts = np.append(np.arange(0, n, source.rows, dtype=np.int64), n)
        radius = _BEYOND_BOX * (boxes[:, 1] - boxes[:, 0]).max(1, initial=0)
        self._coarse = ChunkIndex(starts, boxes[:, 0], boxes[:, 1], radius)
        self._is_read, self._is_coloured = np.zeros((2, len(boxes)), dtype=bool)
        self._position_sh = np.zeros((0, 1, 3), np.float32)
        self._gaussians: Gaussians | None = None
        fine = np.append(np.arange(0, n, _ROWS, dtype=np.int64), n)
        unknown = np.full((len(fine) - 1, 3), np.nan)  # not visible: every comparison is False
        self._fine = ChunkIndex(fine, unknown, unknown.copy(), unknown[:, 0].copy())

    @classmethod
    def of(cls, gaussians: Gaussians) -> ChunkedGaussians:
        """Return Gaussians that are in memory."""
        n = len(gaussians)
        box = np.stack([gaussians.means.min(0), gaussians.means.max(0)])[None] if n else np.zeros((0, 2, 3))
        out = cls(ChunkSource(n, box.astype(np.float64), max(n, 1), lambda ranges: gaussians[:0]))
        out._gaussians, out._fine, out._is_read[:] = gaussians, ChunkIndex.build(gaussians), True
        return out

    @property
    def box(self) -> np.ndarray:
        """(2, 3) box around all Gaussians."""
        boxes = self._source.boxes
        return np.stack([boxes[:, 0].min(0), boxes[:, 1].max(0)]) if len(boxes) else np.zeros((2, 3))

    def seen_from(self, camera: Cameras) -> tuple[Gaussians, ChunkIndex]:
        """Read what one camera may see; return arrays of all N Gaussians, and an index of those that were read."""
        missing = self._needed(camera) & ~self._is_read
        if missing.any() or self._gaussians is None:
            self._read(np.flatnonzero(missing))
        assert self._gaussians is not None
        return self._gaussians, self._fine

    def coloured_by_position(self, camera: Cameras) -> tuple[Gaussians, ChunkIndex]:
        """Return the same as `seen_from`, with the means as colours: (0, 0, 0) at one corner of ``box``, (1, 1, 1) at
        the opposite corner."""
        gaussians, index = self.seen_from(camera)
        if len(self._position_sh) != len(gaussians):
            self._position_sh = np.empty((len(gaussians), 1, 3), np.float32)
        low, high = self.box
        missing = self._is_read & ~self._is_coloured
        for start, stop in join_ranges(self._coarse.starts, np.flatnonzero(missing)):
            rgb = (gaussians.means[start:stop] - low) / np.maximum(high - low, 1e-9)
            self._position_sh[start:stop, 0] = sh0_of_rgb(rgb)
        self._is_coloured |= missing
        return replace(gaussians, sh=self._position_sh), index

    def _needed(self, camera: Cameras) -> np.ndarray:
        """Return the (C,) mask of the chunks that a camera may see."""
        width, height = camera.sizes_px[0].tolist()
        view = camera.T_camera_frame[0], camera.intrinsics_px[0], width, height
        needed = np.zeros(len(self._is_read), dtype=bool)
        for start, stop in self._coarse.visible_ranges(*view).tolist():
            needed[start // self._source.rows : -(-stop // self._source.rows)] = True
        return needed

    def _read(self, chunks: np.ndarray) -> None:
        """Read chunks into the arrays, and add them to the fine index."""
        if not len(chunks):
            self._put(self._source.read([]), 0)
        for start, stop in self._coarse.starts[np.stack([chunks, chunks + 1], axis=1)].tolist():
            # One at a time, so that the memory of one chunk is used again for the next.
            self._put(self._source.read([(start, stop)]), start)
        self._is_read[chunks] = True

    def _put(self, part: Gaussians, start: int) -> None:
        """Copy a chunk to the rows from ``start`` on."""
        n, stop = self._source.num_gaussians, start + len(part)
        if self._gaussians is None:
            shapes = {name: (n, *getattr(part, name).shape[1:]) for name in FIELDS}
            self._gaussians = Gaussians(**{name: np.empty(shape, np.float32) for name, shape in shapes.items()})
        for name in FIELDS:
            getattr(self._gaussians, name)[start:stop] = getattr(part, name)
        built, first = ChunkIndex.build(part, _ROWS), start // _ROWS
        for name in ("low", "high", "radius"):
            values = getattr(built, name)
            getattr(self._fine, name)[first : first + len(values)] = values

"""Gaussians of which each chunk is read when a camera first sees it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from gsmap.render import native
from gsmap.render.index import ChunkIndex, join_ranges
from gsmap.render.outputs import Rendering, image_size
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

    Colours, four fifths of the bytes at SH degree 3, are read of fewer chunks than shapes: of those in which some run
    of `_ROWS` Gaussians is visible. A render of a camera is the same, bit for bit, as one of all Gaussians.
    """

    def __init__(self, source: ChunkSource) -> None:
        self._source = source
        n, boxes = source.num_gaussians, source.boxes
        starts = np.append(np.arange(0, n, source.rows, dtype=np.int64), n)
        radius = _BEYOND_BOX * (boxes[:, 1] - boxes[:, 0]).max(1, initial=0)
        self._coarse = ChunkIndex(starts, boxes[:, 0], boxes[:, 1], radius)
        self._has_shape, self._has_colour = np.zeros((2, len(boxes)), dtype=bool)
        shapes = (n, 3), (n, 4), (n, 3), (n,), (n, (source.sh_degree + 1) ** 2, 3)
        self._gaussians = Gaussians(*(np.empty(shape, np.float32) for shape in shapes))
        fine = np.append(np.arange(0, n, _ROWS, dtype=np.int64), n)
        unknown = np.full((len(fine) - 1, 3), np.nan)  # not visible: every comparison is False
        self._fine = ChunkIndex(fine, unknown, unknown.copy(), unknown[:, 0].copy())

    @classmethod
    def of(cls, gaussians: Gaussians) -> ChunkedGaussians:
        """Return Gaussians that are in memory."""
        n = len(gaussians)
        box = np.stack([gaussians.means.min(0), gaussians.means.max(0)])[None] if n else np.zeros((0, 2, 3))
        out = cls(ChunkSource(n, gaussians.sh_degree, box.astype(np.float64), max(n, 1), lambda *rows: None))
        out._gaussians, out._fine = gaussians, ChunkIndex.build(gaussians)
        out._has_shape[:] = out._has_colour[:] = True
        return out

    def seen_from(self, camera: Cameras) -> tuple[Gaussians, ChunkIndex]:
        """Read what one camera may see; return arrays of all N Gaussians, and an index of those that were read."""
        for start, stop, part in self._read(FIELDS[:-1], self._coarse, camera, self._has_shape):
            built, rows = ChunkIndex.build(part, _ROWS), slice(start // _ROWS, -(-stop // _ROWS))
            self._fine.low[rows], self._fine.high[rows], self._fine.radius[rows] = built.low, built.high, built.radius
        for _ in self._read(FIELDS[-1:], self._fine, camera, self._has_colour):
            pass
        return self._gaussians, self._fine

    def render(self, camera: Cameras, *, with_centres: bool = False) -> Rendering:
        """Render colour, alpha and depth from one camera, and with ``with_centres`` also `Rendering.centre`."""
        gaussians, index = self.seen_from(camera)
        width, height = image_size(camera)
        images = native.allocate(1, height, width, len(gaussians), True, False, False)
        if with_centres:
            images["centre"] = np.empty((1, height, width, 2), np.float32)
        at = camera.T_camera_frame[0], camera.intrinsics_px[0], np.zeros(3, np.float32)
        with native.workspace() as view:
            native.draw(view, native.arrays_of(gaussians), *at, images, 0, index)
        return Rendering(**images)

    def _read(
        self, fields: Sequence[str], index: ChunkIndex, camera: Cameras, done: np.ndarray
    ) -> Iterator[tuple[int, int, Gaussians]]:
        """Read fields of the stored chunks that a camera may see according to an index, and mark them in ``done`` (C,);
        yield the rows of each run of neighbouring chunks."""
        rows, size_px = self._source.rows, camera.sizes_px[0].tolist()
        seen = np.zeros(len(done), dtype=bool)
        for start, stop in index.visible_ranges(camera.T_camera_frame[0], camera.intrinsics_px[0], *size_px).tolist():
            seen[start // rows : -(-stop // rows)] = True
        missing = seen & ~done
        for start, stop in join_ranges(self._coarse.starts, np.flatnonzero(missing)).tolist():
            part = self._gaussians[start:stop]
            self._source.read(fields, start, stop, part)
            yield start, stop, part
        done |= missing

"""Collect the surface cells of two captures, with evidence of change from the views of both."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from gsmap._native import beyond_ranges
from gsmap.change.poses import tints
from gsmap.compare import CaptureViews, ComparedView, Observations, View, count_looks_at
from gsmap.compare.colours import FLOOR, Balance, largest_channel, log_colours
from gsmap.compare.structure import normals_of
from gsmap.geometry.cells import cell_labels, group_means
from gsmap.geometry.sh import rgb_of_sh0

CELL_M = 0.05  # surfaces are judged by cells of this size
_MIN_CHROMA, _MIN_LIGHTNESS = 0.05, 0.15  # smallest differences, of colours in [0, 1], that may be a change
_COLOUR_SIGMAS = 3.0  # largest difference due to exposure and noise, in robust standard deviations
_CLIP_M = 0.15  # larger offsets come from another surface, not from noise
_STEEPEST = 0.2  # smallest cosine of the viewing angle at which an offset is measured
_MOST_DIFFERENT = 3.0  # a larger difference of appearance, relative to the smallest that counts, counts as this one


@dataclass(frozen=True, eq=False)
class SurfaceCells:
    """The surface of one capture in M cells, with evidence from the views of both captures.

    Args:
        rows: (R,) Gaussians of the capture on surfaces; ``label`` (R,) is the cell of each.
        points, colours: (M, 3) mean positions and colours of the cells.
        through, on: (M,) number of views of the other capture in which a Gaussian is in free space or on the surface,
            summed over the Gaussians of the cell.
        offset_m: (M,) mean distance, along the normal, of the other capture's surface behind this one.
        colour: (M, 3) mean difference of colour, two of chroma and one of lightness, newer minus older.
        strength: (M,) size of the difference relative to the smallest that counts; texture that is shifted by a pixel
            is ignored.
        pixels: (M,) number of pixels that show the cell in both captures.
        appearance: (M, 2) sums of the strength over the pixels that show the cell, with the other capture's surface on
            it or behind it, from the cameras of this capture and from the other's.
        appearance_pixels: (M, 2) numbers of these pixels.
    """

    rows: np.ndarray
    label: np.ndarray
    points: np.ndarray
    colours: np.ndarray
    through: np.ndarray
    on: np.ndarray
    offset_m: np.ndarray
    colour: np.ndarray
    strength: np.ndarray
    pixels: np.ndarray
    appearance: np.ndarray
    appearance_pixels: np.ndarray

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def tree(self) -> Any:
        return cKDTree(self.points)

    @cached_property
    def tints(self) -> np.ndarray:
        """(M, 3) tints of the colours; see `gsmap.change.poses.tints`."""
        return tints(self.colours)

    @cached_property
    def normals(self) -> np.ndarray:
        """(M, 3) unit normals; their signs are arbitrary."""
        return normals_of(self.points)

    def around(self, values: np.ndarray, radius_m: float) -> np.ndarray:
        """Return the (M, ...) sums of values over the cells within a radius of each cell."""
        return self._neighbours(radius_m) @ values

    def _neighbours(self, radius_m: float) -> Any:
        cached = self.__dict__.setdefault("_sparse", {})
        if radius_m not in cached:
            from scipy.sparse import coo_matrix, identity

            pairs = self.tree.query_pairs(radius_m, output_type="ndarray")
            ones = np.ones(len(pairs), np.float32)
            half = coo_matrix((ones, (pairs[:, 0], pairs[:, 1])), shape=(len(self), len(self))).tocsr()
            cached[radius_m] = half + half.T + identity(len(self), np.float32, format="csr")
        return cached[radius_m]


@dataclass(eq=False)
class _Cells:
    """The surface of a capture by cells, with sums over the pixels that show each of the M cells.

    Args:
        rows: (R,) Gaussians on surfaces; ``label`` (R,) is the cell of each, ``counts`` (M,) their number in each.
        cell_of: (N,) cell of each Gaussian, -1 for Gaussians off surfaces.
    """

    rows: np.ndarray
    label: np.ndarray
    counts: np.ndarray
    cell_of: np.ndarray
    offset: np.ndarray
    colour: np.ndarray
    strength: np.ndarray
    pixels: np.ndarray
    appearance: np.ndarray
    appearance_pixels: np.ndarray

    @classmethod
    def of(cls, capture: CaptureViews) -> _Cells:
        rows = np.flatnonzero(capture.surface)
        label, counts = cell_labels(np.floor(capture.gaussians.means[rows].astype(np.float64) / CELL_M))
        cell_of = np.full(len(capture.surface), -1, dtype=np.int64)
        cell_of[rows] = label
        m = len(counts)
        shapes = ((m,), (m, 3), (m,), (m,), (m, 2), (m, 2))
        return cls(rows, label, counts, cell_of, *(np.zeros(shape) for shape in shapes))


def compare_surfaces(older: CaptureViews, newer: CaptureViews, seen: Observations) -> tuple[SurfaceCells, SurfaceCells]:
    """Accumulate the evidence on the surface cells of both captures."""
    cells = _Cells.of(older), _Cells.of(newer)
    limits = _limits(seen.balance)
    for own, pictures in ((1, seen.newer_views), (0, seen.older_views)):
        for k, picture in enumerate(pictures):
            views = (picture.own, picture.other) if own == 0 else (picture.other, picture.own)
            colour, strength = _colour(views[0].colour, views[1].colour, seen.balance, limits)
            # Every second view suffices for means of large surfaces, because neighbouring views show the same content.
            if k % 2 != own:
                _add(cells, views, picture, seen, colour, strength)
            _add_appearance(cells, views, own, seen, strength)
    return (
        _side(older, cells[0], newer, seen.newer_views, seen.tolerance_m, seen.balance),
        _side(newer, cells[1], older, seen.older_views, seen.tolerance_m, None),
    )


def _limits(line: Balance) -> tuple[float, float]:
    """Return the smallest differences of chroma and lightness that count."""
    return (
        max(_MIN_CHROMA, _COLOUR_SIGMAS * line.chroma_spread),
        max(_MIN_LIGHTNESS, _COLOUR_SIGMAS * line.lightness_spread),
    )


def _add(
    cells: tuple[_Cells, _Cells],
    views: tuple[View, View],
    picture: ComparedView,
    seen: Observations,
    colour: np.ndarray,
    strength: np.ndarray,
) -> None:
    """Add the views of the older and the newer capture from one camera, and their differences; see `_colour`."""
    a, b = views
    base, share = seen.tolerance_m
    one = a.solid & b.solid & (a.dominant_id >= 0) & (b.dominant_id >= 0)
    one &= np.abs(a.depth - b.depth) <= base + share * a.depth
    difference, beyond = colour[one], strength[one]
    offset = np.clip((b.depth - a.depth) * _along_normal(picture.own), -_CLIP_M, _CLIP_M)[one]
    for into, view, sign in zip(cells, views, (1.0, -1.0), strict=True):
        cell, count = into.cell_of[view.dominant_id[one]], len(into.pixels)
        shown = np.flatnonzero(cell >= 0)
        cell = cell[shown]
        into.pixels += np.bincount(cell, minlength=count)
        into.strength += np.bincount(cell, beyond[shown], count)
        for k in range(3):
            into.colour[:, k] += np.bincount(cell, difference[shown, k], count)
        into.offset += np.bincount(cell, sign * offset[shown], count)


def _add_appearance(
    cells: tuple[_Cells, _Cells], views: tuple[View, View], own: int, seen: Observations, strength: np.ndarray
) -> None:
    """Add the strength of the differences from a camera of the older (``own`` 0) or the newer capture (1).

    Each capture looks like the place from its own cameras, whatever shape its training gave to a blurred or seldom seen
    surface. So a change shows from the cameras of both captures.
    """
    base, share = seen.tolerance_m
    both, strength = views[0].opaque & views[1].opaque, np.minimum(strength, _MOST_DIFFERENT)
    for k, (into, view, other) in enumerate(zip(cells, views, views[::-1], strict=True)):
        shown = both & (view.dominant_id >= 0) & (view.depth < other.depth + base + share * view.depth)
        cell = into.cell_of[view.dominant_id[shown]]
        found, count = cell >= 0, len(into.pixels)
        into.appearance_pixels[:, int(k != own)] += np.bincount(cell[found], minlength=count)
        into.appearance[:, int(k != own)] += np.bincount(cell[found], strength[shown][found], count)


def _colour(a: np.ndarray, b: np.ndarray, line: Balance, limits: tuple[float, float]):
    """Return differences of colour (H, W, 3), two of chroma and one of lightness, and the strength (H, W) of the
    differences.

    The strength is relative to the limits, after subtracting the difference that a shift by a pixel explains.
    """
    log_a = log_colours(a) * line.slope.astype(np.float32) + line.offset.astype(np.float32)
    log_b = log_colours(b)
    bright = np.minimum(np.exp(largest_channel(np.maximum(log_a, log_b))), 1)
    plain = _opponent(log_b - log_a, bright)
    # Texture that is shifted by a pixel, or blurred in one capture, stays within the other capture's range around the
    # pixel.
    strengths = []
    for x, y in ((log_a, log_b), (log_b, log_a)):
        beyond = _opponent(beyond_ranges(x, y), bright)
        red, blue, lightness = np.moveaxis(np.abs(beyond), -1, 0)
        strengths.append(np.maximum(np.maximum(red, blue) / limits[0], lightness / limits[1]))
    return plain, np.minimum(*strengths)


def _opponent(ratio: np.ndarray, bright: np.ndarray) -> np.ndarray:
    """Return red and blue relative to green, and the mean of all three, as in `gsmap.compare.Balance.differences`."""
    green = ratio[..., 1]
    mean = (ratio[..., 0] + green + ratio[..., 2]) / np.float32(3)  # far faster than ``mean`` along short rows
    parts = [ratio[..., 0] - green, ratio[..., 2] - green, mean]
    return np.stack(parts, axis=-1) * bright[..., None]


def _along_normal(view: Any) -> np.ndarray:
    """Return the (H, W) metres along the surface normal per metre of depth."""
    fx, fy, cx, cy = view.camera.intrinsics_px[0]
    height, width = view.depth.shape
    x = np.broadcast_to((np.arange(width) + 0.5 - cx) / fx, (height, width))
    y = np.broadcast_to(((np.arange(height) + 0.5 - cy) / fy)[:, None], (height, width))
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).astype(np.float32)
    points = rays * view.depth[..., None]
    across, down = np.zeros_like(points), np.zeros_like(points)
    across[:, 1:-1] = points[:, 2:] - points[:, :-2]
    down[1:-1] = points[2:] - points[:-2]
    normal = np.cross(across, down)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    # The distance of two planes along the normal is their depth difference times |n . ray|, for rays of unit depth.
    return np.clip(np.abs((normal * rays).sum(-1)), _STEEPEST, 1.0)


def _side(
    capture: CaptureViews,
    cells: _Cells,
    other: CaptureViews,
    pictures: tuple[ComparedView, ...],
    tolerance_m: tuple[float, float],
    line: Balance | None,
) -> SurfaceCells:
    """Return the surface cells of a capture.

    Args:
        other: the other capture; ``pictures`` are its views.
        line: map of the capture's colours to those of the other capture; None for the identity.
    """
    rows, label, counts = cells.rows, cells.label, cells.counts
    points = capture.gaussians.means[rows].astype(np.float64)
    colours = np.clip(rgb_of_sh0(capture.gaussians.sh[rows, 0]).astype(np.float64), 0, 1)
    if line is not None:
        colours = np.clip(np.exp(np.log(colours + FLOOR) * line.slope + line.offset) - FLOOR, 0, 1)
    looks = count_looks_at(capture.gaussians.means[rows], other, pictures, tolerance_m)
    counts_seen = np.maximum(cells.pixels, 1)
    return SurfaceCells(
        rows,
        label,
        group_means(points, label, counts),
        group_means(colours, label, counts),
        np.bincount(label, looks.through, len(counts)),
        np.bincount(label, looks.on_surface, len(counts)),
        cells.offset / counts_seen,
        cells.colour / counts_seen[:, None],
        cells.strength / counts_seen,
        cells.pixels,
        cells.appearance,
        cells.appearance_pixels,
    )

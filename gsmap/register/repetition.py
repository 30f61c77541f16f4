"""Find where else a source agrees with a target in shape and colour about as well as under a given pose.

In a corridor, a colonnade or a parking deck, and along a façade, a pose that is one period off agrees nearly
everywhere; in a stairwell, so does a pose that is a storey off, and in a symmetric room a pose that is turned. The
nodes of the scene graphs propose some of these poses, never all. Therefore the surfaces are correlated over all shifts,
at every quarter turn about the vertical, by fast Fourier transforms of grids of cells.

The constants were chosen on synthetic halls and façades (`tools.bench.repetitive`, seeds 101 to 104).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from gsmap.geometry.directions import level_frame
from gsmap.register.evidence import OPPONENT
from gsmap.register.surface import Surface
from gsmap.types import Sim3

_CELL_M = np.array([0.2, 0.2, 0.4])  # cells are taller than wide, as most places repeat along the ground;
_MAX_CELLS = 4_000_000  # of the box of a surface: cells are doubled until it has no more,
_MAX_SHIFTS = 16_000_000  # and no more shifts at any quarter turn
_STRAY = 0.01  # share of points on each side of each axis that are strays if they lie half the others' extent outside
_BLUR_CELLS = 0.7  # so that shifts by a fraction of a cell matter little
_AROUND = (3, 5, 5)  # cells (z, x, y) over which the mean colour is subtracted
_MIN_CELLS = 150  # fewer common cells correlate by chance,
_MIN_SHARE = 0.25  # and so do fewer than this share of those under the given pose
MARGIN = 0.3
"""A pose is told from another, and from chance, if the surfaces are more similar under it by this much (`fisher_z`)."""
_MOST = 0.98  # correlations count up to this
_PARTS = np.array([[0, 0, 0], [0.5, 0, 0], [0, 0.5, 0], [0.5, 0.5, 0]])  # of a cell by which the cells are offset
_RISES = 0.0, 0.5  # of a cell, by which the source is raised at each quarter turn
_MAX_PEAKS = 50  # at each turn and rise
_PEAK_CELLS = 3, 7, 7  # (z, x, y) within which only the highest correlation counts
_REFINEMENT = 0.2  # by which the similarity may rise when a pose is refined
_MAX_LOSS = 0.2  # of correlation between the cells, at most
_ZXY, _XYZ = [2, 0, 1], [1, 2, 0]  # orders of axes
_ROUNDING = 1e-4  # of sums of squares by fast Fourier transforms
_STOREY_M = 2.0  # no storey is lower; along smaller rises courses of bricks agree, never whole storeys
_DISTANCE_M = 1.0  # nearer poses are refined to the given one


class Repetition:
    """The colours of two surfaces, compared under poses near and far from a given one.

    Args:
        target, source: surfaces in metres; ``pose`` (target from source) as well.
        up: (3,) direction against gravity in the target's frame; if it is None, the direction that most of the target's
            surface faces.
    """

    def __init__(self, target: Surface, source: Surface, pose: Sim3, up: np.ndarray | None) -> None:
        if up is None:
            up = np.linalg.eigh(target.normals.T @ target.normals)[1][:, -1]
        self._pose, self._level = pose, Sim3(level_frame(up), np.zeros(3))
        self._points, self._moved = self._level.apply(target.coarse[0]), (self._level @ pose).apply(source.coarse[0])
        kept = [_without_strays(points) for points in (self._points, self._moved)]
        self._points, self._moved, self._source = self._points[kept[0]], self._moved[kept[1]], source.coarse[0][kept[1]]
        self._colours = target.coarse[1][kept[0]], source.coarse[1][kept[1]]
        self._cell_m = _CELL_M
        sizes = np.array(
            [np.ptp(points, axis=0) if len(points) else np.zeros(3) for points in (self._points, self._moved)]
        )
        while _is_too_large(sizes / self._cell_m + 1):
            self._cell_m = 2 * self._cell_m

    def similarity(self, pose: Sim3) -> float:
        """Return how similar both surfaces are under a pose: `fisher_z` of the correlation of their colours, averaged
        over positions of the cells; NaN where they have too little in common.
        """
        moved = (self._level @ pose).apply(self._source)
        grids = (self._grids(moved, part * self._cell_m) for part in _PARTS)
        return fisher_z(float(np.mean([_common_correlation(*pair) for pair in grids])))

    def _grids(self, moved: np.ndarray, offset: np.ndarray) -> tuple[_Grid, _Grid]:
        """Return the target, and the source whose points are moved, in cells that are offset."""
        target, source = self._colours
        return (
            _Grid.of(self._points + offset, target, self._cell_m),
            _Grid.of(moved + offset, source, self._cell_m),
        )

    def elsewhere(self) -> list[tuple[Sim3, float]]:
        """Return poses far from the given one under which the surfaces may be about as similar, or more so, once they
        are refined, with the similarities now; the most similar first.
        """
        from scipy.ndimage import maximum_filter

        grid, other = self._grids(self._moved, np.zeros(3))
        own = fisher_z(_common_correlation(grid, other))
        if not np.isfinite(own):
            return []
        found, centre, enough = list[tuple[Sim3, float]](), np.median(self._moved, axis=0), 0.0
        least = max(own - MARGIN, MARGIN) - _REFINEMENT
        for quarter, rise in itertools.product(range(4), _RISES):
            turn = _quarter_turn(quarter, centre, rise * self._cell_m[2])
            other = _Grid.of(turn.apply(self._moved), self._colours[1], self._cell_m)
            correlation, count = _correlate(grid, other)
            shape = np.array(count.shape)
            extent, first = np.array(other.occupied.shape), (other.low - grid.low)[_ZXY]
            if not enough:
                enough = max(_MIN_SHARE * count[tuple(first % shape)], _MIN_CELLS)
            correlation[count < enough] = 0.0
            is_peak = (correlation == maximum_filter(correlation, _PEAK_CELLS, mode="wrap")) & (count >= enough)
            peaks = np.argwhere(is_peak & (correlation > np.tanh(least) - _MAX_LOSS))
            for at in peaks[np.argsort(-correlation[tuple(peaks.T)], kind="stable")[:_MAX_PEAKS]]:
                peak, part = _interpolated(correlation, at)
                shift = ((at + extent) % shape - extent - first + part)[_XYZ] * self._cell_m
                S = Sim3(turn.rotation, turn.translation + shift)
                is_elsewhere = quarter or np.linalg.norm(S.translation) > _DISTANCE_M
                is_a_floor = not self._cell_m[2] <= abs(S.translation[2]) < _STOREY_M
                if fisher_z(peak) >= least and is_elsewhere and is_a_floor:
                    found.append((self._level.inverse() @ S @ self._level @ self._pose, fisher_z(peak)))
        return sorted(found, key=lambda one: -one[1])


def _without_strays(points: np.ndarray) -> np.ndarray:
    """Return a mask of the points that do not lie far outside all others, which would make the boxes of cells huge."""
    if not len(points):
        return np.zeros(0, bool)
    low, high = np.quantile(points, [_STRAY, 1 - _STRAY], axis=0)
    margin = 0.5 * (high - low) + _CELL_M
    inside: np.ndarray = ((points >= low - margin) & (points <= high + margin)).all(1)
    return inside


def _is_too_large(cells: np.ndarray) -> bool:
    """Return whether boxes of (2, 3) cells of target and source take too much memory and time to correlate."""
    shifts = cells[:, :2].max(1).sum() ** 2 * cells[:, 2].sum()
    return bool(cells.prod(1).max() > _MAX_CELLS or shifts > _MAX_SHIFTS)


def _interpolated(values: np.ndarray, at: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the height of a peak (Z, X, Y) between the cells, by a parabola along each axis, and its (3,) offset in
    cells from the cell ``at``."""
    height, offset = float(values[tuple(at)]), np.zeros(3)
    for axis in range(3):
        step = np.eye(3, dtype=np.int64)[axis]
        before, after = (float(values[tuple((at + side * step) % values.shape)]) for side in (-1, 1))
        bend = before - 2 * values[tuple(at)] + after
        if bend < 0:
            offset[axis] = np.clip(0.5 * (before - after) / bend, -0.5, 0.5)
            height -= 0.25 * (before - after) * offset[axis]
    return height, offset


def fisher_z(correlation: float) -> float:
    """Return Fisher's transform of a correlation, whose differences are about equally significant everywhere."""
    return float(np.arctanh(np.clip(correlation, -_MOST, _MOST)))


def _quarter_turn(quarter: int, centre: np.ndarray, rise_m: float) -> Sim3:
    """Return the rotation by a number of quarter turns about the vertical through a point, and a rise."""
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarter]
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return Sim3(rotation, centre - rotation @ centre + np.array([0.0, 0.0, rise_m]))


@dataclass(frozen=True, eq=False)
class _Grid:
    """Cells of a surface.

    Args:
        low: (3,) integer coordinates of the first cell: x, y, z.
        occupied: (Z, X, Y) float32, 1 where a cell holds surface.
        contrast: (3, Z, X, Y) float32 difference of the mean colour of a cell from that around it, 0 where it is empty.
    """

    low: np.ndarray
    occupied: np.ndarray
    contrast: np.ndarray

    @property
    def high(self) -> np.ndarray:
        """(3,) integer coordinates after the last cell."""
        high: np.ndarray = self.low + np.array(self.occupied.shape)[[1, 2, 0]]
        return high

    @classmethod
    def of(cls, points: np.ndarray, colours: np.ndarray, cell_m: np.ndarray) -> _Grid:
        from scipy.ndimage import gaussian_filter, uniform_filter

        if not len(points):
            return cls(np.zeros(3, np.int64), np.zeros((1, 1, 1), np.float32), np.zeros((3, 1, 1, 1), np.float32))
        cells = np.floor(points / cell_m).astype(np.int64)
        low = cells.min(0)
        x, y, z = (cells - low).T
        shape = int(z.max()) + 1, int(x.max()) + 1, int(y.max()) + 1
        flat, size = (z * shape[1] + x) * shape[2] + y, int(np.prod(shape))
        count = np.bincount(flat, minlength=size)
        occupied = (count > 0).astype(np.float32).reshape(shape)
        blur = (0.0, _BLUR_CELLS, _BLUR_CELLS)
        weight = np.maximum(
            gaussian_filter(count.astype(np.float32).reshape(shape), blur, mode="constant"), np.float32(1e-6)
        )
        around = np.maximum(uniform_filter(occupied, _AROUND, mode="constant"), np.float32(1e-6))
        contrast = np.empty((3, *shape), np.float32)
        for channel, values in zip(contrast, (colours @ OPPONENT).T, strict=True):
            sums = np.bincount(flat, values, size).astype(np.float32).reshape(shape)
            channel[:] = gaussian_filter(sums, blur, mode="constant") / weight * occupied
            channel -= uniform_filter(channel, _AROUND, mode="constant") / around
            channel *= occupied
        return cls(low, occupied, contrast)


def _common_correlation(target: _Grid, source: _Grid) -> float:
    """Return the correlation of contrasts over the cells that are occupied in both grids; NaN if these are too few."""
    low, high = np.maximum(target.low, source.low), np.minimum(target.high, source.high)
    if (high <= low).any():
        return float("nan")
    parts = []
    for grid in (target, source):
        x, y, z = (slice(f, t) for f, t in zip(low - grid.low, high - grid.low, strict=True))
        parts.append((grid.occupied[z, x, y] > 0, grid.contrast[:, z, x, y]))
    common = parts[0][0] & parts[1][0]
    if common.sum() < _MIN_CELLS:
        return float("nan")
    a, b = (contrast[:, common] for _, contrast in parts)
    return float((a * b).sum() / np.sqrt((a * a).sum() * (b * b).sum() + 1e-9))


def _correlate(target: _Grid, source: _Grid) -> tuple[np.ndarray, np.ndarray]:
    """Return, for every shift between the first cells of source and target, the (Z, X, Y) correlation of contrasts over
    the cells that are occupied in both grids, and the (Z, X, Y) number of these; negative shifts are counted from the
    end."""
    from scipy.fft import irfftn, next_fast_len, rfftn

    shapes = target.occupied.shape, source.occupied.shape
    size = [next_fast_len(a + b, real=True) for a, b in zip(*shapes, strict=True)]

    def spectra(grid: _Grid) -> Iterator[np.ndarray]:
        return (rfftn(values, s=size) for values in (grid.occupied, (grid.contrast**2).sum(0), *grid.contrast))

    pairs = zip(spectra(target), spectra(source), strict=True)
    (occupied_t, occupied_s), (squares_t, squares_s) = next(pairs), next(pairs)
    count = irfftn(occupied_t * occupied_s.conj(), s=size)
    # Less contrast than this share of the most is a rounding error of the transforms.
    norms = (irfftn(a * b.conj(), s=size) for a, b in ((squares_t, occupied_s), (occupied_t, squares_s)))
    norm = np.prod([np.maximum(squares, _ROUNDING * squares.max() + 1e-9) for squares in norms], axis=0)
    products = sum(a * b.conj() for a, b in pairs)
    return irfftn(products, s=size) / np.sqrt(norm), count

"""Segment rooms: the floor plan of a place is cut at walls, lintels of doors and narrow passages.

Between the height of doors and the ceiling there are only walls and lintels, so a connected area of the plan at that
height is one room, whatever its furniture. If doors reach the ceiling, or lintels are unobserved, a passage narrower
than `_DOOR_M` separates two rooms (as in Bormann et al. 2016, "Room segmentation: survey, implementation, and
analysis").
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy import ndimage

from gsmap.geometry.boxes import box_around
from gsmap.geometry.rotations import quats_to_matrices
from gsmap.types import Gaussians, Room

_BIN_M = 0.05  # bin of a histogram of heights
_CELL_M = 0.1  # edge of the cells of the floor plan
_MAX_GAUSSIANS = 150_000  # of a capture, sampled evenly; neighbouring captures fill the gaps
_CUBE_MASK = (1 << 20) - 1  # low bits of a cube's index along an axis: places 50 km apart share one
_MIN_OPACITY = 0.5  # smallest opacity of a surface
_ABOVE_DOORS_M = 2.12  # height above the floor from which on there are only walls and lintels
_BELOW_CEILING_M = 0.1  # walls are detected up to this distance from the ceiling
_DEFAULT_CEILING_M = 2.4  # height of the ceiling above the floor if no ceiling was seen
_MIN_WALL_FILL = 0.5  # smallest fraction of the height in between that a wall fills
_MIN_WALL_M = 0.8  # smallest length of a wall
_DOOR_M = 1.2  # a narrower passage separates two rooms
_STOREY_M = 1.5  # smallest difference in height between cameras of two storeys
_MIN_DOOR_M = 0.5  # smallest width of an opening that joins two rooms


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points on the surfaces of one scene, in a level frame in metres (z up).

    Args:
        points: (P, 3) float32.
        is_level: (P,) bool mask of points on level surfaces.
    """

    points: np.ndarray
    is_level: np.ndarray

    @property
    def box(self) -> np.ndarray | None:
        """Box (2, 3) around the points; None without points."""
        return box_around(self.points).astype(np.float64) if len(self.points) else None

    def within(self, bounds: np.ndarray) -> SurfacePoints:
        """Return the points whose x and y lie in bounds (2, 2)."""
        rows = ((self.points[:, :2] >= bounds[0]) & (self.points[:, :2] < bounds[1])).all(1)
        return self if rows.all() else SurfacePoints(self.points[rows], self.is_level[rows])


def find_rooms(captures: Sequence[Gaussians], eyes: np.ndarray, min_area_m2: float = 1.5) -> list[Room]:
    """Segment the rooms of a place, the largest first.

    Args:
        captures: Gaussians of the place's scenes in one level frame, in metres, z up.
        eyes: (C, 3) camera centres, which separate storeys; may be empty.
        min_area_m2: smallest floor area of a room.
    """
    surfaces = [sample_surface(one[surface_rows(one.logit_opacities)]) for one in captures]
    return order_rooms(segment_rooms(surfaces, eyes, min_area_m2))


def segment_rooms(surfaces: Sequence[SurfacePoints], eyes: np.ndarray, min_area_m2: float) -> list[Room]:
    """Segment the rooms of a place, storey by storey, from the surfaces of its scenes; see `find_rooms`."""
    points = np.concatenate([np.zeros((0, 3)), *(one.points for one in surfaces)])
    flat = np.concatenate([np.zeros(0, bool), *(one.is_level for one in surfaces)])
    scene_of = np.repeat(np.arange(len(surfaces)), [len(one.points) for one in surfaces])
    if len(points) < 100:
        return []
    rooms: list[Room] = []
    for height in _storeys(eyes, points):
        floor, ceiling = _floor_and_ceiling(points[flat, 2], height)
        mine = (points[:, 2] > floor - 0.3) & (points[:, 2] < ceiling + 0.3)
        if mine.any():
            rooms += _segment_storey(points[mine], flat[mine], scene_of[mine], floor, ceiling, len(rooms), min_area_m2)
    return rooms


def order_rooms(rooms: Sequence[Room]) -> list[Room]:
    """Return the rooms, the largest first, with their doors numbered accordingly."""
    order = sorted(range(len(rooms)), key=lambda i: (-rooms[i].area_m2, *rooms[i].low))
    place = {old: new for new, old in enumerate(order)}
    return [replace(rooms[i], doors=tuple(sorted(place[d] for d in rooms[i].doors))) for i in order]


def surface_rows(logit_opacities: np.ndarray) -> np.ndarray:
    """Return the rows of the Gaussians of a scene (N,) that `sample_surface` takes: opaque, and not too many."""
    rows = np.flatnonzero(logit_opacities > np.log(_MIN_OPACITY / (1 - _MIN_OPACITY)))
    return rows[:: -(-len(rows) // _MAX_GAUSSIANS) or 1]


def sample_surface(gaussians: Gaussians) -> SurfacePoints:
    """Sample points on Gaussians half a cell apart, one in each cube of that size.

    A blank wall consists of few wide Gaussians, whose means alone would leave holes.
    """
    scales, axes = gaussians.scales.astype(np.float64), quats_to_matrices(gaussians.quats)
    order = np.argsort(-scales, axis=1)
    rows = np.arange(len(gaussians))
    wide = [axes[rows, :, order[:, k]] * scales[rows, order[:, k]][:, None] for k in (0, 1)]
    level = np.abs(axes[rows, 2, order[:, 2]]) > 0.8
    step = _CELL_M / 2
    counts = np.stack([np.clip(np.ceil(2 * scales[rows, order[:, k]] / step), 1, 15) for k in (0, 1)], 1).astype(int)
    points, flat = [np.zeros((0, 3), np.float32)], [np.zeros(0, bool)]
    for a, b in np.unique(counts, axis=0):
        mine = np.flatnonzero((counts == (a, b)).all(1))
        u, v = (np.linspace(-1, 1, n) if n > 1 else np.zeros(1) for n in (a, b))
        grid = np.stack(np.meshgrid(u, v, indexing="ij"), -1).reshape(-1, 2)
        at = gaussians.means[mine].astype(np.float64)[:, None] + sum(
            grid[None, :, k, None] * wide[k][mine][:, None] for k in (0, 1)
        )
        points.append(at.reshape(-1, 3).astype(np.float32))
        flat.append(np.repeat(level[mine], len(grid)))
    every, is_level = np.concatenate(points), np.concatenate(flat)
    cubes = np.floor(every / step).astype(np.int64) & _CUBE_MASK
    keys = (cubes[:, 0] << 42 | cubes[:, 1] << 21 | cubes[:, 2]) * 2 + is_level
    first = np.sort(np.unique(keys, return_index=True)[1])
    return SurfacePoints(every[first], is_level[first])


def _storeys(eyes: np.ndarray, points: np.ndarray) -> list[float]:
    """Return the median camera height of each storey, lowest first; without cameras, the median height of all
    points."""
    if not len(eyes):
        return [float(np.median(points[:, 2]))]
    heights = np.sort(eyes[:, 2])
    cuts = np.flatnonzero(np.diff(heights) > _STOREY_M) + 1
    return [float(np.median(part)) for part in np.split(heights, cuts)]


def _floor_and_ceiling(heights: np.ndarray, eye: float) -> tuple[float, float]:
    """Estimate the heights of floor and ceiling from the level surfaces below and above the cameras."""
    floor = _mode(heights[(heights > eye - 2.0) & (heights < eye - 0.6)], eye - 1.5)
    above = heights[(heights > floor + _ABOVE_DOORS_M) & (heights < floor + 4.0)]
    below = np.count_nonzero(np.abs(heights - floor) < _BIN_M)
    ceiling = _mode(above, floor + _DEFAULT_CEILING_M)
    if np.count_nonzero(np.abs(above - ceiling) < _BIN_M) < 0.1 * below:
        ceiling = floor + _DEFAULT_CEILING_M
    return floor, ceiling


def _mode(values: np.ndarray, default: float) -> float:
    if not len(values):
        return default
    bins = np.floor(values / _BIN_M).astype(int)
    best = np.argmax(np.bincount(bins - bins.min())) + bins.min()
    return float(np.median(values[np.abs(bins - best) <= 1]))


def _segment_storey(
    points: np.ndarray,
    flat: np.ndarray,
    scene_of: np.ndarray,
    floor: float,
    ceiling: float,
    first: int,
    min_area_m2: float,
) -> list[Room]:
    """Segment the rooms of one storey, numbered from ``first``.

    Args:
        flat: (P,) mask of points on level surfaces.
        scene_of: (P,) index of the scene of each point.
    """
    cell = _CELL_M
    low = points[:, :2].min(0) - 3 * cell
    at = np.floor((points[:, :2] - low) / cell).astype(int)
    shape = tuple(at.max(0) + 4)
    bottom, top = floor + _ABOVE_DOORS_M, ceiling - _BELOW_CEILING_M
    bins = max(round((top - bottom) / _BIN_M), 1)
    filled = np.zeros((*shape, bins), bool)
    high = (points[:, 2] >= bottom) & (points[:, 2] < top)
    level = np.minimum(((points[high, 2] - bottom) / (top - bottom) * bins).astype(int), bins - 1)
    filled[at[high, 0], at[high, 1], level] = True
    wall = _remove_short(filled.mean(2) >= _MIN_WALL_FILL, _MIN_WALL_M / cell)
    inside = np.zeros(shape, bool)
    seen = flat & ((np.abs(points[:, 2] - floor) < 0.15) | (np.abs(points[:, 2] - ceiling) < 0.15))
    inside[at[seen, 0], at[seen, 1]] = True
    body = (points[:, 2] > floor + 0.3) & (points[:, 2] < floor + 1.9)
    blocked = np.zeros(shape, bool)
    blocked[at[body, 0], at[body, 1]] = True
    inside = ndimage.binary_fill_holes(ndimage.binary_closing(inside | blocked, np.ones((3, 3)), iterations=2))
    labels = _label_rooms(inside & ~wall, min_area_m2)
    grown = _extend_to_walls(labels, wall & inside)
    # A door that is open in one scene is a door, even if it is shut in another scene.
    open_floors = []
    trodden = flat & (np.abs(points[:, 2] - floor) < _BIN_M)
    for capture in np.unique(scene_of):
        seen, stands = (at[(scene_of == capture) & mask] for mask in (trodden, body))
        floors = np.zeros(shape, bool)
        floors[seen[:, 0], seen[:, 1]] = True
        floors[stands[:, 0], stands[:, 1]] = False
        open_floors.append(floors)
    joined: list[set[int]] = [set() for _ in range(labels.max() + 1)]
    for one, other in _joined_rooms(labels, open_floors):
        joined[one].add(first + other - 1)
        joined[other].add(first + one - 1)
    rooms = []
    for number, found in enumerate(ndimage.find_objects(grown), 1):
        part = grown[found] == number
        begins = np.array([span.start for span in found])
        rooms.append(Room(low + cell * begins, part, cell, floor, ceiling, tuple(sorted(joined[number]))))
    return rooms


def _remove_short(wall: np.ndarray, cells: float) -> np.ndarray:
    """Remove pieces of wall that are shorter than a number of cells, such as lamps and ducts."""
    labels, _ = ndimage.label(wall, np.ones((3, 3)))
    spans = ndimage.find_objects(labels)
    long = [max(s.stop - s.start for s in span) >= cells for span in spans]
    out: np.ndarray = np.array([False, *long])[labels]
    return out


def _label_rooms(free: np.ndarray, min_area_m2: float) -> np.ndarray:
    """Return the labels (X, Y) of the rooms of a free floor, from 1; 0 for no room.

    Each core of floor that is wider than a door forms a room, together with the cells that are nearest to it by walking
    distance. A piece of floor without a core is one room.
    """
    distance = ndimage.distance_transform_edt(free) * _CELL_M
    pieces, _ = ndimage.label(free)
    cores, _ = ndimage.label(distance > _DOOR_M / 2)
    least = min_area_m2 / _CELL_M**2
    out = np.zeros(free.shape, int)
    number = 0
    for piece, window in enumerate(ndimage.find_objects(pieces), 1):
        mine = pieces[window] == piece
        if mine.sum() < least:
            continue
        own = np.where(mine, cores[window], 0)
        inner = [core for core in np.unique(own) if core]
        labels = np.zeros(own.shape, int)
        for k, core in enumerate(inner, 1):
            labels[own == core] = k
        if not inner:
            labels[mine] = 1
        labels = _flood(labels, mine)
        for k in range(1, labels.max() + 1):
            if (labels == k).sum() >= least:
                number += 1
                out[window][labels == k] = number
    return out


def _flood(labels: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Extend labels over the free cells; each cell gets the label that is nearest in steps."""
    cross = ndimage.generate_binary_structure(2, 1)
    while True:
        spread = ndimage.grey_dilation(labels, footprint=cross)
        new = (labels == 0) & free & (spread > 0)
        if not new.any():
            return labels
        labels = np.where(new, spread, labels)


def _extend_to_walls(labels: np.ndarray, wall: np.ndarray) -> np.ndarray:
    """Extend labels to adjacent wall cells, because half of these lie in front of the wall."""
    spread = ndimage.grey_dilation(labels, size=(3, 3))
    return np.where((labels == 0) & wall, spread, labels)


_REACH = 4  # cells from a room to its doors: through a wall of up to 60 cm


def _joined_rooms(labels: np.ndarray, open_floors: Sequence[np.ndarray]) -> Iterator[tuple[int, int]]:
    """Yield the pairs of rooms that open floor, at least as wide as a door, connects in any scene.

    Args:
        labels: (X, Y) labels of rooms, without their walls.
        open_floors: mask (X, Y) of each scene.
    """
    near = {}
    for number, found in enumerate(ndimage.find_objects(labels), 1):
        window = tuple(slice(max(span.start - _REACH, 0), span.stop + _REACH) for span in found)
        around = ndimage.binary_dilation(labels[window] == number, np.ones((2 * _REACH + 1,) * 2, bool))
        near[number] = window, around
    for one, other in combinations(near, 2):
        (a, mine), (b, theirs) = near[one], near[other]
        shared = tuple(slice(max(s.start, t.start), min(s.stop, t.stop)) for s, t in zip(a, b, strict=True))
        if any(span.start >= span.stop for span in shared):
            continue
        between = mine[_inside(shared, a)] & theirs[_inside(shared, b)]
        if between.any() and any(
            _is_door(labels[shared], one, other, between & floors[shared]) for floors in open_floors
        ):
            yield one, other


def _inside(window: tuple[slice, ...], of: tuple[slice, ...]) -> tuple[slice, ...]:
    """Return a window relative to the begin of another one."""
    return tuple(slice(s.start - t.start, s.stop - t.start) for s, t in zip(window, of, strict=True))


def _is_door(labels: np.ndarray, one: int, other: int, between: np.ndarray) -> bool:
    """Return whether open floor between two rooms connects them."""
    passages, _ = ndimage.label(between)
    both = np.intersect1d(passages[labels == one], passages[labels == other])
    for passage in both[both > 0]:
        rows, columns = np.nonzero((passages == passage) & (labels != one) & (labels != other))
        cut = not len(rows)  # one piece of floor that was cut at its narrowest place
        if cut or max(np.ptp(rows), np.ptp(columns)) + 1 >= _MIN_DOOR_M / _CELL_M:
            return True
    return False

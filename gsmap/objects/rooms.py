"""Segment rooms: the floor plan of a place is cut at walls, lintels of doors and narrow passages.

Between the height of doors and the ceiling there are only walls and lintels, so a connected area of the plan at that
height is one room, whatever its furniture. If doors reach the ceiling, or lintels are unobserved, a passage narrower
than `_DOOR_M` separates two rooms (as in Bormann et al. 2016, "Room segmentation: survey, implementation, and
analysis").
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from gsmap.geometry.rotations import quats_to_matrices
from gsmap.types import Gaussians, Room

_BIN_M = 0.05  # bin of a histogram of heights
_CELL_M = 0.1  # edge of the cells of the floor plan
_MAX_GAUSSIANS = 150_000  # of a capture, sampled evenly; neighbouring captures fill the gaps
_MIN_OPACITY = 0.5  # smallest opacity of a surface
_ABOVE_DOORS_M = 2.12  # height above the floor from which on there are only walls and lintels
_BELOW_CEILING_M = 0.1  # walls are detected up to this distance from the ceiling
_DEFAULT_CEILING_M = 2.4  # height of the ceiling above the floor if no ceiling was seen
_MIN_WALL_FILL = 0.5  # smallest fraction of the height in between that a wall fills
_MIN_WALL_M = 0.8  # smallest length of a wall
_DOOR_M = 1.2  # a narrower passage separates two rooms
_STOREY_M = 1.5  # smallest difference in height between cameras of two storeys
_MIN_DOOR_M = 0.5  # smallest width of an opening that joins two rooms


def find_rooms(captures: Sequence[Gaussians], eyes: np.ndarray, min_area_m2: float = 1.5) -> list[Room]:
    """Segment the rooms of a place, the largest first.

    Args:
        captures: Gaussians of the place's scenes in one level frame, in metres, z up.
        eyes: (C, 3) camera centres, which separate storeys; may be empty.
        min_area_m2: smallest floor area of a room.
    """
    parts = [_surface(gaussians) for gaussians in captures]
    points = np.concatenate([np.zeros((0, 3)), *(p for p, _ in parts)])
    flat = np.concatenate([np.zeros(0, bool), *(f for _, f in parts)])
    scene_of = np.repeat(np.arange(len(parts)), [len(p) for p, _ in parts])
    if len(points) < 100:
        return []
    rooms: list[Room] = []
    for height in _storeys(eyes, points):
        floor, ceiling = _floor_and_ceiling(points[flat, 2], height)
        mine = (points[:, 2] > floor - 0.3) & (points[:, 2] < ceiling + 0.3)
        rooms += _segment_storey(points[mine], flat[mine], scene_of[mine], floor, ceiling, len(rooms), min_area_m2)
    order = sorted(range(len(rooms)), key=lambda i: (-rooms[i].area_m2, *rooms[i].low))
    place = {old: new for new, old in enumerate(order)}
    return [
        Room(r.low, r.cells, r.cell_m, r.floor_m, r.ceiling_m, tuple(sorted(place[d] for d in r.doors)))
        for r in (rooms[i] for i in order)
    ]


def _surface(gaussians: Gaussians) -> tuple[np.ndarray, np.ndarray]:
    """Sample points (P, 3) on the Gaussians, half a cell apart; return them with a mask of the points on level
    surfaces.

    A blank wall consists of few wide Gaussians, whose means alone would leave holes.
    """
    opaque = gaussians.logit_opacities > np.log(_MIN_OPACITY / (1 - _MIN_OPACITY))
    rows = np.flatnonzero(opaque)
    kept = gaussians[rows[:: -(-len(rows) // _MAX_GAUSSIANS) or 1]]
    scales, axes = kept.scales.astype(np.float64), quats_to_matrices(kept.quats)
    order = np.argsort(-scales, axis=1)
    rows = np.arange(len(kept))
    wide = [axes[rows, :, order[:, k]] * scales[rows, order[:, k]][:, None] for k in (0, 1)]
    level = np.abs(axes[rows, 2, order[:, 2]]) > 0.8
    step = _CELL_M / 2
    counts = np.stack([np.clip(np.ceil(2 * scales[rows, order[:, k]] / step), 1, 15) for k in (0, 1)], 1).astype(int)
    points, flat = [], []
    for a, b in np.unique(counts, axis=0):
        mine = np.flatnonzero((counts == (a, b)).all(1))
        u, v = (np.linspace(-1, 1, n) if n > 1 else np.zeros(1) for n in (a, b))
        grid = np.stack(np.meshgrid(u, v, indexing="ij"), -1).reshape(-1, 2)
        at = kept.means[mine].astype(np.float64)[:, None] + sum(
            grid[None, :, k, None] * wide[k][mine][:, None] for k in (0, 1)
        )
        points.append(at.reshape(-1, 3))
        flat.append(np.repeat(level[mine], len(grid)))
    return np.concatenate([np.zeros((0, 3)), *points]), np.concatenate([np.zeros(0, bool), *flat])


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
    rooms = []
    for number in range(1, labels.max() + 1):
        mine = grown == number
        rows, columns = np.flatnonzero(mine.any(1)), np.flatnonzero(mine.any(0))
        part = mine[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        doors = {other for floors in open_floors for other in _connected_rooms(labels, number, floors)}
        joined = tuple(first + other - 1 for other in sorted(doors))
        rooms.append(Room(low + cell * np.array([rows[0], columns[0]]), part, cell, floor, ceiling, joined))
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
    pieces, count = ndimage.label(free)
    cores, _ = ndimage.label(distance > _DOOR_M / 2)
    least = min_area_m2 / _CELL_M**2
    out = np.zeros(free.shape, int)
    number = 0
    for piece in range(1, count + 1):
        mine = pieces == piece
        if mine.sum() < least:
            continue
        inner = [core for core in np.unique(cores[mine]) if core]
        labels = np.zeros(free.shape, int)
        for k, core in enumerate(inner, 1):
            labels[cores == core] = k
        if not inner:
            labels[mine] = 1
        labels = _flood(labels, mine)
        for k in range(1, labels.max() + 1):
            if (labels == k).sum() >= least:
                number += 1
                out[labels == k] = number
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


def _connected_rooms(labels: np.ndarray, number: int, open_floor: np.ndarray) -> list[int]:
    """Return the numbers of the rooms that open floor, at least as wide as a door, connects to a room.

    Args:
        labels: (X, Y) labels of rooms, without their walls.
    """
    reach = np.ones((9, 9), bool)  # through a wall of up to 60 cm
    mine = ndimage.binary_dilation(labels == number, reach)
    out = []
    for other in range(1, labels.max() + 1):
        if other == number:
            continue
        between = mine & ndimage.binary_dilation(labels == other, reach) & open_floor
        passages, _ = ndimage.label(between)
        both = np.intersect1d(passages[labels == number], passages[labels == other])
        for passage in both[both > 0]:
            rows, columns = np.nonzero((passages == passage) & (labels != number) & (labels != other))
            cut = not len(rows)  # one piece of floor that was cut at its narrowest place
            if cut or max(np.ptp(rows), np.ptp(columns)) + 1 >= _MIN_DOOR_M / _CELL_M:
                out.append(other)
                break
    return out

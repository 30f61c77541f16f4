"""Rooms: the floor plan of a place, cut where walls or the lintels of doors close it, and at narrow passages.

Between the height of doors and the ceiling nothing stands but walls, and above an open door its lintel: what is one
piece of floor there is one room, whatever furniture stands in it. Where doors reach the ceiling, or nobody saw their
lintels, the distance to the nearest wall tells: a passage narrower than `Params.door_m` parts two rooms (as in Bormann
et al. 2016, "Room segmentation: survey, implementation, and analysis").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from gsmap.geometry.rotations import quats_to_matrices
from gsmap.types import Gaussians, Room

_BIN_M = 0.05  # of heights


@dataclass(frozen=True)
class Params:
    """How a place is cut into rooms; lengths in metres.

    Args:
        cell_m: edge of the cells of the plan.
        max_gaussians: of a capture, evenly; of more their neighbours fill the gaps.
        min_opacity: Gaussians that are less opaque are no surface.
        above_m: nothing but walls and lintels stands higher above the floor than this,
        below_m: and lower below the ceiling.
        no_ceiling_m: where no ceiling was seen, walls are looked for up to so far above the floor.
        wall: a column is of a wall where surfaces fill this share of its height in between,
        min_wall_m: and columns of a wall stand in a row of at least this length.
        door_m: passages narrower than this part two rooms.
        min_area_m2: what is smaller is no room.
        storey_m: cameras that stand so much higher than others stand on another storey.
        min_door_m: rooms are joined by an opening of at least this width.
    """

    cell_m: float = 0.1
    max_gaussians: int = 150_000
    min_opacity: float = 0.5
    above_m: float = 2.12
    below_m: float = 0.1
    no_ceiling_m: float = 2.4
    wall: float = 0.5
    min_wall_m: float = 0.8
    door_m: float = 1.2
    min_area_m2: float = 1.5
    storey_m: float = 1.5
    min_door_m: float = 0.5


def find_rooms(captures: Sequence[Gaussians], eyes: np.ndarray, params: Params | None = None) -> list[Room]:
    """The rooms that captures of a place show, the largest first.

    Args:
        captures: in one level frame, metres, z up.
        eyes: (C, 3) where their cameras stood: they tell storeys apart; may be none.
    """
    params = params or Params()
    parts = [_surface(gaussians, params) for gaussians in captures]
    points = np.concatenate([np.zeros((0, 3)), *(p for p, _ in parts)])
    flat = np.concatenate([np.zeros(0, bool), *(f for _, f in parts)])
    whose = np.repeat(np.arange(len(parts)), [len(p) for p, _ in parts])
    if len(points) < 100:
        return []
    rooms: list[Room] = []
    for height in _storeys(eyes, points, params):
        floor, ceiling = _floor_and_ceiling(points[flat, 2], height, params)
        mine = (points[:, 2] > floor - 0.3) & (points[:, 2] < ceiling + 0.3)
        rooms += _of_storey(points[mine], flat[mine], whose[mine], floor, ceiling, len(rooms), params)
    order = sorted(range(len(rooms)), key=lambda i: (-rooms[i].area_m2, *rooms[i].low))
    place = {old: new for new, old in enumerate(order)}
    return [
        Room(r.low, r.cells, r.cell_m, r.floor_m, r.ceiling_m, tuple(sorted(place[d] for d in r.doors)))
        for r in (rooms[i] for i in order)
    ]


def _surface(gaussians: Gaussians, params: Params) -> tuple[np.ndarray, np.ndarray]:
    """Points (P, 3) all over the Gaussians, half a cell apart, and which lie on a level surface.

    Blank walls are made of few wide Gaussians, whose means alone would leave holes.
    """
    opaque = gaussians.logit_opacities > np.log(params.min_opacity / (1 - params.min_opacity))
    rows = np.flatnonzero(opaque)
    kept = gaussians[rows[:: -(-len(rows) // params.max_gaussians) or 1]]
    scales, axes = kept.scales.astype(np.float64), quats_to_matrices(kept.quats)
    order = np.argsort(-scales, axis=1)
    rows = np.arange(len(kept))
    wide = [axes[rows, :, order[:, k]] * scales[rows, order[:, k]][:, None] for k in (0, 1)]
    level = np.abs(axes[rows, 2, order[:, 2]]) > 0.8
    step = params.cell_m / 2
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


def _storeys(eyes: np.ndarray, points: np.ndarray, params: Params) -> list[float]:
    """The height of the eyes on each storey, the lowest first; without cameras the middle of what there is."""
    if not len(eyes):
        return [float(np.median(points[:, 2]))]
    heights = np.sort(eyes[:, 2])
    cuts = np.flatnonzero(np.diff(heights) > params.storey_m) + 1
    return [float(np.median(part)) for part in np.split(heights, cuts)]


def _floor_and_ceiling(heights: np.ndarray, eye: float, params: Params) -> tuple[float, float]:
    """Where most of what is level lies below and above the eyes."""
    floor = _mode(heights[(heights > eye - 2.0) & (heights < eye - 0.6)], eye - 1.5)
    above = heights[(heights > floor + params.above_m) & (heights < floor + 4.0)]
    below = np.count_nonzero(np.abs(heights - floor) < _BIN_M)
    ceiling = _mode(above, floor + params.no_ceiling_m)
    if np.count_nonzero(np.abs(above - ceiling) < _BIN_M) < 0.1 * below:
        ceiling = floor + params.no_ceiling_m
    return floor, ceiling


def _mode(values: np.ndarray, default: float) -> float:
    if not len(values):
        return default
    bins = np.floor(values / _BIN_M).astype(int)
    best = np.argmax(np.bincount(bins - bins.min())) + bins.min()
    return float(np.median(values[np.abs(bins - best) <= 1]))


def _of_storey(
    points: np.ndarray,
    flat: np.ndarray,
    whose: np.ndarray,
    floor: float,
    ceiling: float,
    first: int,
    params: Params,
) -> list[Room]:
    """The rooms of one storey; their numbers begin with ``first``.

    Args:
        flat: (P,) bool, which points lie on a level surface. whose: (P,) index of the capture that shows each.
    """
    cell = params.cell_m
    low = points[:, :2].min(0) - 3 * cell
    at = np.floor((points[:, :2] - low) / cell).astype(int)
    shape = tuple(at.max(0) + 4)
    bottom, top = floor + params.above_m, ceiling - params.below_m
    bins = max(round((top - bottom) / _BIN_M), 1)
    filled = np.zeros((*shape, bins), bool)
    high = (points[:, 2] >= bottom) & (points[:, 2] < top)
    level = np.minimum(((points[high, 2] - bottom) / (top - bottom) * bins).astype(int), bins - 1)
    filled[at[high, 0], at[high, 1], level] = True
    wall = _long(filled.mean(2) >= params.wall, params.min_wall_m / cell)
    inside = np.zeros(shape, bool)
    seen = flat & ((np.abs(points[:, 2] - floor) < 0.15) | (np.abs(points[:, 2] - ceiling) < 0.15))
    inside[at[seen, 0], at[seen, 1]] = True
    body = (points[:, 2] > floor + 0.3) & (points[:, 2] < floor + 1.9)
    blocked = np.zeros(shape, bool)
    blocked[at[body, 0], at[body, 1]] = True
    inside = ndimage.binary_fill_holes(ndimage.binary_closing(inside | blocked, np.ones((3, 3)), iterations=2))
    labels = _cut(inside & ~wall, params)
    grown = _grown(labels, wall & inside)
    # A door that one capture shows open is a door, though another shows it shut.
    open_floors = []
    trodden = flat & (np.abs(points[:, 2] - floor) < _BIN_M)
    for capture in np.unique(whose):
        seen, stands = (at[(whose == capture) & what] for what in (trodden, body))
        floors = np.zeros(shape, bool)
        floors[seen[:, 0], seen[:, 1]] = True
        floors[stands[:, 0], stands[:, 1]] = False
        open_floors.append(floors)
    rooms = []
    for number in range(1, labels.max() + 1):
        mine = grown == number
        rows, columns = np.flatnonzero(mine.any(1)), np.flatnonzero(mine.any(0))
        part = mine[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        doors = {other for floors in open_floors for other in _joined_to(labels, number, floors, params)}
        joined = tuple(first + other - 1 for other in sorted(doors))
        rooms.append(Room(low + cell * np.array([rows[0], columns[0]]), part, cell, floor, ceiling, joined))
    return rooms


def _long(wall: np.ndarray, cells: float) -> np.ndarray:
    """Walls without pieces that are shorter: lamps and ducts hang from ceilings, too."""
    labels, _ = ndimage.label(wall, np.ones((3, 3)))
    spans = ndimage.find_objects(labels)
    long = [max(s.stop - s.start for s in span) >= cells for span in spans]
    out: np.ndarray = np.array([False, *long])[labels]
    return out


def _cut(free: np.ndarray, params: Params) -> np.ndarray:
    """Labels (X, Y) from 1 of the rooms of a free floor, 0 for none.

    Each piece of floor whose middle is wider than a door is a room with what lies nearest to it on foot; one that is
    nowhere so wide is a room as a whole.
    """
    distance = ndimage.distance_transform_edt(free) * params.cell_m
    pieces, count = ndimage.label(free)
    cores, _ = ndimage.label(distance > params.door_m / 2)
    least = params.min_area_m2 / params.cell_m**2
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
        labels = _flooded(labels, mine)
        for k in range(1, labels.max() + 1):
            if (labels == k).sum() >= least:
                number += 1
                out[labels == k] = number
    return out


def _flooded(labels: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Labels spread over the free cells, each going to whose label reaches it in the fewest steps."""
    cross = ndimage.generate_binary_structure(2, 1)
    while True:
        spread = ndimage.grey_dilation(labels, footprint=cross)
        new = (labels == 0) & free & (spread > 0)
        if not new.any():
            return labels
        labels = np.where(new, spread, labels)


def _grown(labels: np.ndarray, wall: np.ndarray) -> np.ndarray:
    """Labels with the cells of walls that they touch: half of such a cell lies before the wall."""
    spread = ndimage.grey_dilation(labels, size=(3, 3))
    return np.where((labels == 0) & wall, spread, labels)


def _joined_to(labels: np.ndarray, number: int, open_floor: np.ndarray, params: Params) -> list[int]:
    """Numbers of the rooms that one can walk to from one: over floor with nothing on it, as wide as a door at least.

    Args:
        labels: (X, Y) of rooms, without their walls.
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
            cut = not len(rows)  # one piece of floor, parted where it is narrow
            if cut or max(np.ptp(rows), np.ptp(columns)) + 1 >= params.min_door_m / params.cell_m:
                out.append(other)
                break
    return out

"""Segment the rooms of a large place tile by tile, and anew only where scenes changed.

A tile is segmented together with its surroundings and keeps the rooms whose centre lies in it. So memory and time
depend on the scenes around a tile, and floors may lie at different heights.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from gsmap.objects.component_scenes import boxes_meet
from gsmap.objects.rooms import SurfacePoints, order_rooms, segment_rooms
from gsmap.types import Room

TILE_M = 32.0
"""Edge of a tile of the floor plan."""
HALO_M = 16.0
"""Width of the surroundings that are segmented with a tile; larger rooms are cut."""

_MAX_BOX_TILES = 1024  # 1 km x 1 km; the tiles of a larger scene are found from its points, which must be loaded

Tile = tuple[int, int]


def update_rooms(
    boxes: Mapping[str, np.ndarray],
    load: Callable[[str], SurfacePoints],
    eyes: Callable[[str], np.ndarray],
    min_area_m2: float,
    earlier: Sequence[Room] = (),
    changed: Sequence[np.ndarray] | None = None,
) -> list[Room]:
    """Return the rooms of a place, the largest first, in a level frame in metres (z up).

    Args:
        boxes: box (2, 3) around the surface points of each scene, by scene id.
        load: function that returns the surface points of a scene.
        eyes: function that returns the camera centres (C, 3) of a scene; may be empty.
        min_area_m2: smallest floor area of a room.
        earlier: rooms of an earlier run.
        changed: boxes (2, 3) of all scenes that came, left or moved since; None segments everything.
    """
    if not boxes or (changed is not None and not len(changed)):
        return list(earlier) if boxes else []
    if is_small(boxes.values()):
        whole = np.array([[-np.inf] * 2, [np.inf] * 2])
        return order_rooms(_rooms_within(whole, boxes, load, eyes, min_area_m2))
    tiles = {tile for scene, box in boxes.items() for tile in _tiles(box, partial(load, scene))}
    touched = sorted(tile for tile in tiles if changed is None or _meets(_window(tile), changed))
    left = tiles.difference(touched) if changed is not None else set[Tile]()  # tiles without scenes have no rooms
    stay = [room for room in earlier if _tile_of(room) in left]
    rooms = list(stay)
    doors = [[earlier[other] for other in room.doors] for room in stay]
    for tile in touched:
        found = _rooms_within(_window(tile), boxes, load, eyes, min_area_m2)
        own = [room for room in found if _tile_of(room) == tile]
        rooms += own
        doors += [[found[other] for other in room.doors] for room in own]
    every = np.array([room.box for room in rooms])
    return order_rooms([replace(room, doors=_places(rooms, every, i, doors[i])) for i, room in enumerate(rooms)])


def is_small(boxes: Iterable[np.ndarray]) -> bool:
    """Return true if a place is segmented as a whole."""
    every = np.array(list(boxes))
    return bool((every[:, 1, :2].max(0) - every[:, 0, :2].min(0)).max() <= TILE_M + 2 * HALO_M)


def _tiles(box: np.ndarray, load: Callable[[], SurfacePoints]) -> set[Tile]:
    """Return the tiles of a box (2, 3); if it has too many, as around stray Gaussians, the tiles of its points."""
    low, high = np.floor(box[:, :2] / TILE_M)
    if np.prod(high - low + 1) > _MAX_BOX_TILES:
        cells = np.unique(np.floor(load().points[:, :2] / TILE_M), axis=0)
    else:
        cells = np.stack(np.meshgrid(*(np.arange(a, b + 1) for a, b in zip(low, high, strict=True))), -1).reshape(-1, 2)
    return {(int(x), int(y)) for x, y in cells.tolist()}


def _rooms_within(
    bounds: np.ndarray,
    boxes: Mapping[str, np.ndarray],
    load: Callable[[str], SurfacePoints],
    eyes: Callable[[str], np.ndarray],
    min_area_m2: float,
) -> list[Room]:
    """Segment the rooms of all scenes in bounds (2, 2) of the floor plan."""
    some = [scene for scene, box in boxes.items() if _meets(bounds, [box])]
    centres = np.concatenate([np.zeros((0, 3)), *map(eyes, some)])
    inside = ((centres[:, :2] >= bounds[0]) & (centres[:, :2] < bounds[1])).all(1)
    return segment_rooms([load(scene).within(bounds) for scene in some], centres[inside], min_area_m2)


def _window(tile: Tile) -> np.ndarray:
    low = np.array(tile, dtype=np.float64) * TILE_M
    return np.array([low - HALO_M, low + TILE_M + HALO_M])


def _meets(bounds: np.ndarray, boxes: Sequence[np.ndarray]) -> bool:
    """Return true if bounds (2, 2) of the floor plan meet any of the boxes (2, 3)."""
    tall = np.column_stack([bounds, [-np.inf, np.inf]])
    return bool(boxes_meet(tall[None], np.array(boxes)).any())


def _tile_of(room: Room) -> Tile:
    x, y = np.floor(room.middle[:2] / TILE_M).astype(int).tolist()
    return x, y


def _places(rooms: Sequence[Room], boxes: np.ndarray, own: int, doors: Sequence[Room]) -> tuple[int, ...]:
    """Return the indices of the rooms, with their ``boxes`` (N, 2, 3), that doors of one room lead to; a room found in
    two tiles is one."""
    out = set()
    for target in doors:
        cells = np.argwhere(target.cells)
        at = target.low + (cells[len(cells) // 2] + 0.5) * target.cell_m
        point = np.array([*at, target.floor_m])
        near = np.flatnonzero(((boxes[:, 0] <= point) & (point <= boxes[:, 1]))[:, :2].all(1))
        out |= {i for i in near.tolist() if rooms[i] is target or (rooms[i].holds(point) and i != own)}
    return tuple(sorted(out - {own}))

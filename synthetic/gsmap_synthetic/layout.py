"""Where things go in a room: along its walls, clear of doorways, of windows and of each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsmap_synthetic.furniture import Piece
from gsmap_synthetic.plan import Door, Room
from gsmap_synthetic.surfaces import Surfaces

Spans = Sequence[Sequence[tuple[float, float]]]
_DOOR_CLEAR_M = 0.8


# The four walls of a room, each as a local frame: x along the wall, y into the room, origin in the middle of the wall.
def walls(size_m: np.ndarray) -> list[tuple[float, float, float, float]]:
    """(x, y, yaw, length) of south, east, north and west wall in room coordinates."""
    w, d = size_m
    return [(w / 2, 0, 0, w), (w, d / 2, np.pi / 2, d), (w / 2, d, np.pi, w), (0, d / 2, 1.5 * np.pi, d)]


def door_spans(room: Room, index: int, doors: list[Door]) -> list[list[tuple[float, float]]]:
    """For each wall, the intervals its doorways take along the wall's local x."""
    spans: list[list[tuple[float, float]]] = [[], [], [], []]
    w, d = room.size_m
    for door in doors:
        if index not in (door.a, door.b):
            continue
        x, y = door.xy - room.rect_m[:2]
        wall = (0 if y < d / 2 else 2) if door.along_x else (3 if x < w / 2 else 1)
        middle = (x - w / 2, y - d / 2, w / 2 - x, d / 2 - y)[wall]
        spans[wall].append((middle - door.width_m / 2, middle + door.width_m / 2))
    return spans


def free_spot(rng, taken: list[tuple[float, float]], length: float, width: float, tries: int = 30) -> float | None:
    """A place along a wall whose interval of the given width meets none that is taken."""
    if length < width + 0.2:
        return None
    for _ in range(tries):
        x = rng.uniform(-length / 2 + width / 2 + 0.1, length / 2 - width / 2 - 0.1)
        if all(x + width / 2 + 0.08 < lo or x - width / 2 - 0.08 > hi for lo, hi in taken):
            return x
    return None


def footprint(x, y, yaw, at, width, depth, offset=0.0) -> np.ndarray:
    """Axis-parallel rectangle, in room coordinates, of a piece on the wall (x, y, yaw)."""
    c, sn = np.cos(yaw), np.sin(yaw)
    local = np.array([[at - width / 2, offset], [at + width / 2, offset + depth]])
    points = np.stack([x + c * local[:, 0] - sn * local[:, 1], y + sn * local[:, 0] + c * local[:, 1]], axis=1)
    return np.concatenate([points.min(0), points.max(0)])


def overlap(a: np.ndarray, b: np.ndarray, gap_m: float = 0.03) -> bool:
    return bool((a[:2] < b[2:] + gap_m).all() and (b[:2] < a[2:] + gap_m).all())


def door_clearance(room: Room, spans: Spans) -> list[np.ndarray]:
    """Rectangles, in room coordinates, that nothing stands in: what lies before every doorway."""
    return [
        footprint(x, y, yaw, (x0 + x1) / 2, x1 - x0 + 0.1, _DOOR_CLEAR_M)
        for wall, (x, y, yaw, _) in enumerate(walls(room.size_m))
        for x0, x1 in spans[wall]
    ]


@dataclass(frozen=True, eq=False)
class Spot:
    """Where a piece may stand: (dx, dy) in the frame (x, y, yaw) of the room, and the rectangle it takes there."""

    x: float
    y: float
    yaw: float
    dx: float
    dy: float
    rect_m: np.ndarray
    wall: int

    def frame(self, s: Surfaces) -> Surfaces:
        """``s``, in the room's frame, seen from that of the piece."""
        return s.at(self.x, self.y, 0, self.yaw).at(self.dx, self.dy)


def find_spot(
    rng, room: Room, piece: Piece, size_m: tuple[float, float], used: Sequence[np.ndarray], taken: Spans
) -> Spot | None:
    """A random place for a piece of the size (width, depth), clear of the rectangles ``used`` (room coordinates).

    Tall pieces also keep clear of what is ``taken`` on their wall; None where nothing was found.
    """
    (w, d), (width, depth) = room.size_m, size_m
    for _ in range(40):
        wall = int(rng.integers(4))
        x, y, yaw, length = walls(room.size_m)[wall]
        if not piece.against_wall:
            x, y, yaw = rng.uniform(0.35, 0.65) * w, rng.uniform(0.35, 0.65) * d, rng.integers(2) * np.pi / 2
            at, dy, rect = 0.0, -depth / 2, footprint(x, y, yaw, 0, width, depth, -depth / 2)
        elif length > width + 0.1:
            at = rng.uniform(-(length - width) / 2, (length - width) / 2)
            dy = 0.03 if not piece.tall else 0.02
            rect = footprint(x, y, yaw, at, width, depth + dy)
        else:
            continue
        inside = (rect[:2] > -0.01).all() and (rect[2:] < room.size_m + 0.01).all()
        clash = piece.tall and any(at - width / 2 < hi and at + width / 2 > lo for lo, hi in taken[wall])
        if inside and not (piece.against_wall and clash) and not any(overlap(rect, other) for other in used):
            return Spot(x, y, yaw, at, dy, rect, wall)
    return None


def outline(T_room_object: np.ndarray, size_m: tuple[float, float]) -> np.ndarray:
    """Axis-parallel rectangle round the footprint of a thing, at any yaw, in the frame its pose is given in."""
    (width, depth), half = size_m, size_m[0] / 2
    corners = np.array([[-half, 0], [width - half, 0], [width - half, depth], [-half, depth]])
    points = corners @ T_room_object[:2, :2].T + T_room_object[:2, 3]
    return np.concatenate([points.min(0), points.max(0)])

"""A synthetic place: a furnished flat built from a seed.

The plan is a rectangle cut into rooms; every two rooms that share enough wall get a doorway, so the first three form a
cycle. Each room is decorated and furnished from its own seed: two seeds give two clearly different places, one seed
always the same. With ``twin=True`` the whole flat is built a second time beside the first and both open onto a
corridor: two wings that nothing but the corridor tells apart.

Place frame: metres, z up, floor at z = 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from gsmap.errors import ConfigError
from gsmap_synthetic import textures as tx
from gsmap_synthetic.bake import Skin, bake
from gsmap_synthetic.furniture import PIECES, ROOMS, colour, palette, timber
from gsmap_synthetic.surfaces import Surfaces

CEILING_M = 2.55
_DOOR_HEIGHT_M = 2.05
_WALL_M = 0.1


@dataclass(frozen=True, eq=False)
class Room:
    """A room of the plan.

    Args:
        kind: what it is furnished as.
        rect_m: (4,) x0 y0 x1 y1 of its inner walls.
        seed: decides everything in it; twins share it.
        obstacles_m: (n, 4) footprints of what stands higher than a person's shoulder.
    """

    kind: str
    rect_m: np.ndarray
    seed: int
    obstacles_m: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))

    @property
    def center(self) -> np.ndarray:
        return 0.5 * (self.rect_m[:2] + self.rect_m[2:])

    @property
    def size_m(self) -> np.ndarray:
        return self.rect_m[2:] - self.rect_m[:2]

    def is_free(self, xy: np.ndarray, margin_m: float = 0.4) -> np.ndarray:
        """(n,) whether a head at the points (n, 2) stays clear of walls and tall furniture."""
        low, high = self.rect_m[:2] + margin_m, self.rect_m[2:] - margin_m
        free = np.asarray(((xy >= low) & (xy <= high)).all(1))
        for rect in self.obstacles_m:
            free &= ~((xy > rect[:2] - margin_m) & (xy < rect[2:] + margin_m)).all(1)
        return free


@dataclass(frozen=True, eq=False)
class Door:
    """A doorway between rooms ``a`` and ``b`` (indices): its middle, its width, and whether its wall runs along x."""

    a: int
    b: int
    xy: np.ndarray
    width_m: float
    along_x: bool


@dataclass(frozen=True, eq=False)
class Place:
    """A built place: the plan, and the skin of its surfaces (quads, baked colours, ray casting)."""

    seed: int
    rooms: tuple[Room, ...]
    doors: tuple[Door, ...]
    skin: Skin

    def door_between(self, a: int, b: int) -> Door | None:
        return next((d for d in self.doors if {d.a, d.b} == {a, b}), None)


def make_place(
    seed: int = 0,
    *,
    rooms: int = 3,
    twin: bool = False,
    texel_m: float = 0.008,
    progress: Callable[[float, str], None] | None = None,
) -> Place:
    """Build the place of a seed: plan, walls, furniture, light.

    Args:
        seed: which place.
        rooms: how many rooms a wing has, 3 or more; the flat grows with them.
        twin: build the wing twice, side by side, joined by a corridor (the last room).
        texel_m: how fine the baked colours are.

    Raises:
        ConfigError: fewer than 3 rooms.
    """
    if rooms < 3:
        raise ConfigError(f"a synthetic place has at least 3 rooms, got rooms={rooms}")
    plan, doors = _plan(np.random.default_rng([seed, 1]), rooms)
    if twin:
        plan, doors = _with_twin(plan, doors, seed)
    surfaces = Surfaces()
    built = [_build_room(surfaces, room, i, doors) for i, room in enumerate(plan)]
    for index, door in enumerate(doors):
        _build_door(surfaces, door, index, seed)
    skin = bake(surfaces, texel_m=texel_m, progress=progress)
    return Place(seed, tuple(built), tuple(doors), skin)


def _plan(rng: np.random.Generator, count: int) -> tuple[list[Room], list[Door]]:
    """Cut a rectangle into rooms: one cut across, one half cut along, then the largest room again and again."""
    stretch = np.sqrt(count / 3)
    width, depth = rng.uniform(7.2, 8.4) * stretch, rng.uniform(5.6, 6.6) * stretch
    x, y = rng.uniform(0.42, 0.5) * width, rng.uniform(0.44, 0.56) * depth
    rects = [[0, 0, x, depth], [x, 0, width, y], [x, y, width, depth]]
    while len(rects) < count:
        i = int(np.argmax([(r[2] - r[0]) * (r[3] - r[1]) for r in rects]))
        x0, y0, x1, y1 = rects.pop(i)
        f = rng.uniform(0.42, 0.58)
        if x1 - x0 > y1 - y0:
            m = x0 + f * (x1 - x0)
            rects += [[x0, y0, m, y1], [m, y0, x1, y1]]
        else:
            m = y0 + f * (y1 - y0)
            rects += [[x0, y0, x1, m], [x0, m, x1, y1]]
    kinds = ["living room", *rng.permutation(["kitchen", "bedroom", "study"]), "bathroom"]
    rooms = [
        Room(
            str(kinds[i % len(kinds)]),
            np.array(r) + 0.5 * _WALL_M * np.array([1, 1, -1, -1]),
            int(rng.integers(1 << 30)),
        )
        for i, r in enumerate(rects)
    ]
    doors = []
    for a in range(count):
        for b in range(a + 1, count):
            door = _door(rng, a, b, np.array(rects[a]), np.array(rects[b]))
            doors += [door] if door else []
    return rooms, doors


def _door(rng: np.random.Generator, a: int, b: int, ra: np.ndarray, rb: np.ndarray) -> Door | None:
    """A doorway where two rectangles of the plan share at least 1.5 m of wall."""
    low, high = np.maximum(ra[:2], rb[:2]), np.minimum(ra[2:], rb[2:])
    for axis in (0, 1):
        other = 1 - axis
        touches = abs(ra[other + 2] - rb[other]) < 1e-6 or abs(rb[other + 2] - ra[other]) < 1e-6
        if touches and high[axis] - low[axis] > 1.5:
            width = rng.uniform(0.9, 1.1)
            xy = np.zeros(2)
            xy[axis] = rng.uniform(low[axis] + width / 2 + 0.2, high[axis] - width / 2 - 0.2)
            xy[other] = low[other]
            return Door(a, b, xy, width, axis == 0)
    return None


def _with_twin(plan: list[Room], doors: list[Door], seed: int) -> tuple[list[Room], list[Door]]:
    n, half = len(plan), 0.5 * _WALL_M
    width = max(r.rect_m[2] for r in plan) + half
    shift = np.array([width + 0.4, 0, width + 0.4, 0])
    twins = [replace(r, rect_m=r.rect_m + shift) for r in plan]
    twin_doors = [replace(d, a=d.a + n, b=d.b + n, xy=d.xy + shift[:2]) for d in doors]
    corridor = Room("corridor", np.array([half, -1.9 + half, 2 * width + 0.4 - half, -half]), seed + 77)
    entry = np.array([plan[0].center[0], 0.0])
    entries = [Door(0, 2 * n, entry, 1.0, True), Door(n, 2 * n, entry + shift[:2], 1.0, True)]
    return [*plan, *twins, corridor], [*doors, *twin_doors, *entries]


# The four walls of a room, each as a local frame: x along the wall, y into the room, origin in the middle of the wall.
def _walls(size_m: np.ndarray) -> list[tuple[float, float, float, float]]:
    """(x, y, yaw, length) of south, east, north and west wall in room coordinates."""
    w, d = size_m
    return [(w / 2, 0, 0, w), (w, d / 2, np.pi / 2, d), (w / 2, d, np.pi, w), (0, d / 2, 1.5 * np.pi, d)]


def _door_spans(room: Room, index: int, doors: list[Door]) -> list[list[tuple[float, float]]]:
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


def _build_room(surfaces: Surfaces, room: Room, index: int, doors: list[Door]) -> Room:
    rng = np.random.default_rng([room.seed, 2])
    s = surfaces.at(room.rect_m[0], room.rect_m[1])
    spans = _door_spans(room, index, doors)
    _build_shell(s, rng, room, spans)
    taken = [list(span) for span in spans]
    outside = [all(not span for span in spans) or _is_outer(room, wall, index, doors) for wall in range(4)]
    _place_windows(s, rng, room, taken, outside)
    obstacles = _place_furniture(s, rng, room, spans, taken)
    _place_pictures(s, rng, room, taken)
    return replace(room, obstacles_m=obstacles)


def _is_outer(room: Room, wall: int, index: int, doors: list[Door]) -> bool:
    """Whether a wall may have a window: it has no doorway (a window onto a neighbour's wall does no harm)."""
    return not _door_spans(room, index, doors)[wall]


def _build_shell(s: Surfaces, rng: np.random.Generator, room: Room, spans) -> None:
    """Floor, ceiling with a lamp, walls with their doorways, and trim."""
    w, d = room.size_m
    seed = int(rng.integers(1 << 20))
    pale, deep = colour(rng, saturation=(0.08, 0.55), value=(0.6, 0.95)), colour(rng, value=(0.3, 0.7))
    floors = [
        tx.planks(timber(rng), seed, rng.uniform(0.1, 0.2), bool(rng.integers(2))),
        tx.tiles(
            colour(rng, saturation=(0.05, 0.4), value=(0.4, 0.9)),
            colour(rng, value=(0.2, 0.6)),
            seed,
            rng.uniform(0.2, 0.45),
            int(rng.integers(3)),
        ),
        tx.fabric(
            colour(rng, value=(0.3, 0.6)),
            colour(rng, value=(0.2, 0.5)),
            seed,
            int(rng.integers(4)),
            rng.uniform(0.3, 0.6),
        ),
    ]
    liked = {"bathroom": 1, "kitchen": int(rng.integers(2)), "bedroom": int(rng.choice([0, 2]))}
    s.rectangle([0, 0, 0], [w, 0, 0], [0, d, 0], floors[liked.get(room.kind, 0)])
    s.rectangle([0, d, CEILING_M], [w, 0, 0], [0, -d, 0], tx.plaster(np.full(3, 0.8), seed + 1))
    papers = [
        tx.plaster(pale, seed + 2),
        tx.wallpaper(pale, 0.6 * pale + 0.4 * deep, seed + 2, int(rng.integers(4)), rng.uniform(0.1, 0.3)),
    ]
    upper = [papers[int(rng.random() < 0.4)]] * 4
    if rng.random() < 0.6:  # One wall in another colour.
        upper[int(rng.integers(4))] = tx.plaster(deep, seed + 3)
    panel_m = rng.uniform(0.8, 1.15) if rng.random() < 0.5 or room.kind == "bathroom" else 0.0
    lower = tx.wood(timber(rng), seed + 4, True)
    if room.kind in ("bathroom", "kitchen"):
        lower = tx.tiles(
            colour(rng, saturation=(0.1, 0.5), value=(0.5, 0.9)), deep, seed + 4, 0.15, int(rng.integers(3))
        )
    trim = tx.wood(timber(rng), seed + 5)
    for wall, (x, y, yaw, length) in enumerate(_walls(room.size_m)):
        f = s.at(x, y, 0, yaw)
        cuts = sorted(spans[wall])
        edges = [-length / 2, *(e for cut in cuts for e in cut), length / 2]
        for x0, x1 in zip(edges[::2], edges[1::2], strict=True):
            if panel_m:
                f.rectangle([x1, 0, 0], [x0 - x1, 0, 0], [0, 0, panel_m], lower, (-x1, 7.0 * wall))
                f.box((x0 + x1) / 2, 0.012, panel_m, x1 - x0, 0.024, 0.05, trim)
            f.rectangle([x1, 0, panel_m], [x0 - x1, 0, 0], [0, 0, CEILING_M - panel_m], upper[wall], (-x1, 7.0 * wall))
            f.box((x0 + x1) / 2, 0.008, 0, x1 - x0, 0.016, 0.09, trim)
        for x0, x1 in cuts:
            f.rectangle(
                [x1, 0, _DOOR_HEIGHT_M], [x0 - x1, 0, 0], [0, 0, CEILING_M - _DOOR_HEIGHT_M], upper[wall], (-x1, 3.0)
            )
            f.box((x0 + x1) / 2, 0.015, _DOOR_HEIGHT_M, x1 - x0 + 0.16, 0.03, 0.08, trim)
            for edge in (x0 - 0.04, x1 + 0.04):
                f.box(edge, 0.015, 0, 0.08, 0.03, _DOOR_HEIGHT_M, trim)
    if rng.random() < 0.35:
        beam = tx.wood(timber(rng) * 0.6, seed + 6)
        for x in np.arange(0.5 + rng.uniform(0, 0.4), w - 0.3, rng.uniform(0.8, 1.2)):
            s.box(x, d / 2, CEILING_M - 0.12, 0.12, d, 0.12, beam)
    _pendant(s.at(w / 2 + rng.uniform(-0.3, 0.3), d / 2 + rng.uniform(-0.3, 0.3)), rng)


def _pendant(s: Surfaces, rng: np.random.Generator) -> None:
    drop, radius, warm = (
        rng.uniform(0.3, 0.45),
        rng.uniform(0.16, 0.28),
        colour(rng, (0.07, 0.14), (0.08, 0.3), (0.95, 1.0)),
    )
    s.lathe(0, 0, CEILING_M - drop, [(0.006, 0), (0.006, drop)], tx.plain(np.full(3, 0.05)), 5)
    tint = colour(rng, value=(0.5, 0.95))
    profile = [(radius, 0), (radius * rng.uniform(0.3, 0.9), 0.2)]
    s.lathe(
        0,
        0,
        CEILING_M - drop - 0.1,
        profile,
        tx.fabric(tint, warm, int(rng.integers(99)), int(rng.integers(4)), 0.07),
        14,
        glow=0.5,
    )
    s.lamp(0, 0, CEILING_M - drop - 0.14, warm * 3.6, 0.14)


def _build_door(surfaces: Surfaces, door: Door, index: int, seed: int) -> None:
    """The inside of a doorway's frame, its threshold, and the leaf that is there while the door is shut."""
    rng = np.random.default_rng([seed, 3])
    lining = tx.wood(timber(rng), seed)
    s = surfaces.at(door.xy[0], door.xy[1], 0, 0.0 if door.along_x else np.pi / 2)
    w, t, h = door.width_m / 2, _WALL_M / 2, _DOOR_HEIGHT_M
    s.rectangle([-w, -t, 0], [2 * w, 0, 0], [0, 2 * t, 0], lining)
    s.rectangle([-w, t, h], [2 * w, 0, 0], [0, -2 * t, 0], lining)
    s.rectangle([-w, t, 0], [0, -2 * t, 0], [0, 0, h], lining)
    s.rectangle([w, -t, 0], [0, 2 * t, 0], [0, 0, h], lining)
    s.leaf = index
    tone = timber(rng)
    s.box(0, 0, 0.005, 2 * w, 0.04, h - 0.005, tx.wood(tone, seed + 1, True))
    for z, height in ((0.15, 0.7), (1.05, 0.85)):
        for x in (-w / 2, w / 2):
            s.box(x, 0, z, 0.6 * w, 0.055, height, tx.wood(tone * 0.7, seed + 2, True))
    s.lathe(0.82 * w, 0, 1.0, [(0, 0), (0.05, 0.03), (0.05, 0.06), (0, 0.09)], tx.plain(np.full(3, 0.6)), 8)


def _free_spot(rng, taken: list[tuple[float, float]], length: float, width: float, tries: int = 30) -> float | None:
    """A place along a wall whose interval of the given width meets none that is taken."""
    if length < width + 0.2:
        return None
    for _ in range(tries):
        x = rng.uniform(-length / 2 + width / 2 + 0.1, length / 2 - width / 2 - 0.1)
        if all(x + width / 2 + 0.08 < lo or x - width / 2 - 0.08 > hi for lo, hi in taken):
            return x
    return None


def _place_windows(s: Surfaces, rng, room: Room, taken, outside) -> None:
    frame = tx.plain(np.full(3, 0.75), 5)
    walls = [k for k in rng.permutation(4) if outside[k]][: 1 + int(rng.random() < 0.3)]
    for wall in walls:
        x, y, yaw, length = _walls(room.size_m)[wall]
        width, z, height = rng.uniform(0.9, 1.5), rng.uniform(0.9, 1.05), rng.uniform(1.0, 1.2)
        at = _free_spot(rng, taken[wall], length, width + 0.5)
        if at is None:
            continue
        f = s.at(x, y, 0, yaw).at(at, 0, z)
        f.rectangle(
            [width / 2, 0.012, 0], [-width, 0, 0], [0, 0, height], tx.outdoors(int(rng.integers(1 << 20))), glow=1.0
        )
        for k in range(3):
            f.box((k - 1) * width / 2, 0.02, 0, 0.05, 0.04, height, frame)
        for zz in (-0.05, height):
            f.box(0, 0.03, zz, width + 0.1, 0.06, 0.05, frame)
        cloth = tx.fabric(colour(rng), colour(rng), int(rng.integers(1 << 20)), int(rng.integers(4)))
        for side in (-1, 1):
            f.box(side * (width / 2 + 0.14), 0.06, -0.75, 0.22, 0.06, height + 0.95, cloth)
        f.lamp(0, 0.45, height / 2, np.array([1.0, 1.08, 1.25]) * 1.6, 0.3)
        taken[wall].append((at - width / 2 - 0.3, at + width / 2 + 0.3))


def _place_furniture(s: Surfaces, rng, room: Room, spans, taken) -> np.ndarray:
    """Put the pieces the kind of room asks for where they fit; returns footprints of tall ones, place frame."""
    w, d = room.size_m
    used: list[np.ndarray] = []
    for wall, (x, y, yaw, _) in enumerate(_walls(room.size_m)):  # Keep 0.8 m clear before every doorway.
        for x0, x1 in spans[wall]:
            used.append(_footprint(x, y, yaw, (x0 + x1) / 2, x1 - x0 + 0.1, 0.8))
    obstacles = []
    names = ROOMS.get(room.kind, ["drawers", "plant", "bookshelf", "floor lamp", "armchair"])
    for name in names:
        piece = PIECES[name]
        width, depth = rng.uniform(*piece.width_m), rng.uniform(*piece.depth_m)
        for _ in range(40):
            wall = int(rng.integers(4))
            x, y, yaw, length = _walls(room.size_m)[wall]
            if not piece.against_wall:
                x, y, yaw = rng.uniform(0.35, 0.65) * w, rng.uniform(0.35, 0.65) * d, rng.integers(2) * np.pi / 2
                f, rect, at = (
                    s.at(x, y, 0, yaw).at(0, -depth / 2),
                    _footprint(x, y, yaw, 0, width, depth, -depth / 2),
                    0.0,
                )
            elif length > width + 0.1:
                at = rng.uniform(-(length - width) / 2, (length - width) / 2)
                gap = 0.03 if not piece.tall else 0.02
                f, rect = s.at(x, y, 0, yaw).at(at, gap), _footprint(x, y, yaw, at, width, depth + gap)
            else:
                continue
            inside = (rect[:2] > -0.01).all() and (rect[2:] < room.size_m + 0.01).all()
            window_clash = piece.tall and any(at - width / 2 < hi and at + width / 2 > lo for lo, hi in taken[wall])
            if not inside or (piece.against_wall and window_clash) or any(_overlap(rect, other) for other in used):
                continue
            piece.build(f, rng, width, depth)
            used.append(rect)
            if piece.against_wall and (piece.tall or name in ("drawers", "desk", "sideboard")):
                taken[wall].append((at - width / 2, at + width / 2))
            if piece.tall:
                obstacles.append(rect + np.tile(room.rect_m[:2], 2))
            break
    rw, rd = rng.uniform(0.4, 0.6) * w, rng.uniform(0.4, 0.6) * d
    cx, cy = rng.uniform(0.42, 0.58) * w, rng.uniform(0.42, 0.58) * d
    s.box(cx, cy, 0.001, rw, rd, 0.012, tx.plain(np.full(3, 0.3)), top=tx.rug(palette(rng), int(rng.integers(1 << 20))))
    return np.array(obstacles).reshape(-1, 4)


def _footprint(x, y, yaw, at, width, depth, offset=0.0) -> np.ndarray:
    """Axis-parallel rectangle, in room coordinates, of a piece on the wall (x, y, yaw)."""
    c, sn = np.cos(yaw), np.sin(yaw)
    local = np.array([[at - width / 2, offset], [at + width / 2, offset + depth]])
    points = np.stack([x + c * local[:, 0] - sn * local[:, 1], y + sn * local[:, 0] + c * local[:, 1]], axis=1)
    return np.concatenate([points.min(0), points.max(0)])


def _overlap(a: np.ndarray, b: np.ndarray, gap_m: float = 0.03) -> bool:
    return bool((a[:2] < b[2:] + gap_m).all() and (b[:2] < a[2:] + gap_m).all())


def _place_pictures(s: Surfaces, rng, room: Room, taken) -> None:
    for wall, (x, y, yaw, length) in enumerate(_walls(room.size_m)):
        for _ in range(int(rng.integers(2, 5))):
            width, height = rng.uniform(0.3, 0.9), rng.uniform(0.3, 0.7)
            at = _free_spot(rng, taken[wall], length, width)
            if at is None:
                continue
            f = s.at(x, y, 0, yaw).at(at, 0.015, rng.uniform(1.35, 1.6) - height / 2)
            print_ = tx.picture(palette(rng, int(rng.integers(4, 7))), int(rng.integers(1 << 20)), int(rng.integers(4)))
            f.box(0, 0, 0, width, 0.03, height, tx.wood(timber(rng) * 0.5, int(rng.integers(99))), front=print_)
            taken[wall].append((at - width / 2, at + width / 2))

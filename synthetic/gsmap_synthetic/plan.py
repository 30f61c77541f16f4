"""The plan of a synthetic place: a rectangle cut into rooms, and the doorways between them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

WALL_M = 0.1


@dataclass(frozen=True, eq=False)
class Room:
    """A room of the plan.

    Args:
        kind: what it is furnished as.
        rect_m: (4,) x0 y0 x1 y1 of its inner walls.
        seed: decides everything in it; twins share it.
        layout_seed: decides where the furniture stands, where ``seed`` is to decide the rest alone.
        obstacles_m: (n, 4) footprints of what stands higher than a person's shoulder.
    """

    kind: str
    rect_m: np.ndarray
    seed: int
    obstacles_m: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    layout_seed: int | None = None

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


def make_plan(rng: np.random.Generator, count: int) -> tuple[list[Room], list[Door]]:
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
            np.array(r) + 0.5 * WALL_M * np.array([1, 1, -1, -1]),
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


def with_twin(plan: list[Room], doors: list[Door], seed: int) -> tuple[list[Room], list[Door]]:
    n, half = len(plan), 0.5 * WALL_M
    width = max(r.rect_m[2] for r in plan) + half
    shift = np.array([width + 0.4, 0, width + 0.4, 0])
    twins = [replace(r, rect_m=r.rect_m + shift) for r in plan]
    twin_doors = [replace(d, a=d.a + n, b=d.b + n, xy=d.xy + shift[:2]) for d in doors]
    corridor = Room("corridor", np.array([half, -1.9 + half, 2 * width + 0.4 - half, -half]), seed + 77)
    entry = np.array([plan[0].center[0], 0.0])
    entries = [Door(0, 2 * n, entry, 1.0, True), Door(n, 2 * n, entry + shift[:2], 1.0, True)]
    return [*plan, *twins, corridor], [*doors, *twin_doors, *entries]

"""Halls that repeat: corridors, colonnades, parking decks, stairwells, and rooms that look alike from several sides.

One bay follows the other, each the same to the last texel, so that two captures agree wherever one is laid a period
along the other, or turned. What is unique stands or hangs in some bays, or nowhere.

Place frame: metres, x along the hall (up the stairwell: z), z up, the floor at z = 0.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, get_args

import numpy as np

from gsmap.errors import ConfigError
from gsmap.types.progress import Progress
from gsmap_synthetic import textures as tx
from gsmap_synthetic.bake import bake
from gsmap_synthetic.capture import look_along
from gsmap_synthetic.furniture import colour, palette
from gsmap_synthetic.make import DemoCapture, make_captures
from gsmap_synthetic.place import Place
from gsmap_synthetic.surfaces import Surfaces

Kind = Literal["corridor", "colonnade", "parking deck", "symmetric room", "stairwell"]
_GLOW = 0.8
_HIGH_M = 2.6
_WIDTHS_M = {"corridor": 2.4, "colonnade": 9.0, "parking deck": 14.0, "symmetric room": 5.0, "stairwell": 3.0}
_PERIODS_M = {
    "corridor": (2.6, 4.2),
    "colonnade": (3.0, 4.5),
    "parking deck": (4.8, 5.4),
    "symmetric room": (5.0, 5.0),
    "stairwell": (2.7, 3.3),
}
_STOREYS, _DEEP_M, _LANDING_M = 9, 5.0, 1.2  # of a stairwell
LENGTH_M, REACH_M, STEP_M = 46.0, 14.0, 7.0
FAR_M = 12.0
"""Depths beyond this are not captured, so that the ends of a hall are seen only from near."""


def make_hall(
    kind: Kind,
    seed: int = 0,
    *,
    unique: float = 0.3,
    texel_m: float = 0.02,
    progress: Callable[[float, str], None] | None = None,
) -> Place:
    """Build the hall of a seed.

    Args:
        kind: ``corridor`` (doors and lamps on both sides), ``colonnade`` (two rows of columns), ``parking deck``
            (columns and painted bays), ``symmetric room`` (equal walls, as seen after a half or a quarter turn), or
            ``stairwell`` (equal storeys of two flights of stairs).
        unique: things that are like no other, per bay; 0 leaves nothing that tells one bay from the other.

    Raises:
        ConfigError: another kind.
    """
    if kind not in get_args(Kind):
        raise ConfigError(f"a hall is one of {', '.join(get_args(Kind))}, got {kind!r}")
    rng, s = np.random.default_rng([seed, 61, get_args(Kind).index(kind)]), Surfaces()
    width, period = _WIDTHS_M[kind], rng.uniform(*_PERIODS_M[kind])
    if kind == "symmetric room":
        _symmetric_room(s, rng, width, unique)
    elif kind == "stairwell":
        looks = int(rng.integers(1 << 30))
        for k in range(_STOREYS):
            _storey(s.at(0, 0, k * period).object("bay", "shell"), np.random.default_rng(looks), period, width)
            for _ in range(rng.poisson(unique)):
                _unique_thing(s.at(0, -_LANDING_M / 2, k * period), rng, width, _LANDING_M)
    else:
        count = int(np.ceil(LENGTH_M / period))
        build = {"corridor": _corridor_bay, "colonnade": _colonnade_bay, "parking deck": _parking_bay}[kind]
        looks = int(rng.integers(1 << 30))
        for k in range(count):
            build(s.at(k * period, 0).object("bay", "shell"), np.random.default_rng(looks), period, width)
            for _ in range(rng.poisson(unique)):
                _unique_thing(s.at(k * period, 0), rng, period, width)
        for x, turn in ((0.0, -np.pi / 2), (count * period, np.pi / 2)):  # closed at both ends
            end = s.at(x, 0, 0, turn).object("end", "shell")
            tone = tx.picture(palette(rng, 5), int(rng.integers(1 << 20)), int(rng.integers(4)))
            end.rectangle([width / 2, 0, 0], [-width, 0, 0], [0, 0, _HIGH_M], tone, (0, 0), _GLOW)
    return Place(seed, (), (), bake(s, texel_m=texel_m, progress=progress), s)


def _shell(s: Surfaces, rng: np.random.Generator, period: float, width: float) -> None:
    """Floor and ceiling of a bay."""
    tone = colour(rng, saturation=(0.05, 0.4), value=(0.35, 0.8))
    floors = [
        tx.tiles(tone, 0.7 * tone, int(rng.integers(1 << 20)), period / 10, int(rng.integers(3))),
        tx.marble(tone, 0.6 * tone, int(rng.integers(1 << 20))),
    ]
    s.rectangle([0, -width / 2, 0], [period, 0, 0], [0, width, 0], floors[int(rng.integers(2))], (0, 0), _GLOW)
    white = tx.plaster(np.full(3, 0.8), int(rng.integers(1 << 20)))
    s.rectangle([0, width / 2, _HIGH_M], [period, 0, 0], [0, -width, 0], white, (0, 0), _GLOW)


def _walls(s: Surfaces, rng: np.random.Generator, period: float, width: float) -> None:
    """Both walls of a bay, plain."""
    tone = colour(rng, saturation=(0.05, 0.45), value=(0.55, 0.9))
    paper = tx.wallpaper(tone, 0.7 * tone, int(rng.integers(1 << 20)), int(rng.integers(4)), period / 12)
    for side in (-1, 1):
        wall = s.at(period / 2, side * width / 2, 0, np.pi * (side > 0))
        wall.rectangle([period / 2, 0, 0], [-period, 0, 0], [0, 0, _HIGH_M], paper, (0, 0), _GLOW)


def _corridor_bay(s: Surfaces, rng: np.random.Generator, period: float, width: float) -> None:
    _shell(s, rng, period, width)
    _walls(s, rng, period, width)
    leaf, frame = tx.wood(colour(rng, (0.03, 0.12), (0.3, 0.7), (0.3, 0.7)), 7), tx.plain(np.full(3, 0.3), 5)
    sides = (-1, 1) if rng.random() < 0.5 else (1,)
    for side in sides:
        door = s.at(period * 0.4, side * width / 2, 0, np.pi * (side > 0))
        door.box(0, 0.02, 0, 0.95, 0.05, 2.05, leaf, glow=_GLOW)
        door.box(0, 0.03, 2.05, 1.1, 0.08, 0.08, frame, glow=_GLOW)
        door.box(0.75, 0.02, 1.3, 0.2, 0.03, 0.15, tx.plain(colour(rng), 3), glow=_GLOW)  # a plate beside it
    s.box(period / 2, 0, _HIGH_M - 0.08, 1.1, 0.3, 0.08, tx.plain(np.ones(3), 2), glow=1.0)


def _colonnade_bay(s: Surfaces, rng: np.random.Generator, period: float, width: float) -> None:
    _shell(s, rng, period, width)
    _walls(s, rng, period, width)
    stone = tx.marble(colour(rng, (0.05, 0.15), (0.05, 0.3), (0.5, 0.8)), np.full(3, 0.4), int(rng.integers(1 << 20)))
    thick = rng.uniform(0.2, 0.35)
    for side in (-1, 1):
        profile = [(1.5 * thick, 0), (1.5 * thick, 0.2), (thick, 0.3), (thick, 2.3), (1.4 * thick, _HIGH_M)]
        s.lathe(period / 2, side * width / 4, 0, profile, stone, 12, _GLOW)


def _parking_bay(s: Surfaces, rng: np.random.Generator, period: float, width: float) -> None:
    _shell(s, rng, period, width)
    _walls(s, rng, period, width)
    paint, concrete = tx.plain(np.array([0.85, 0.8, 0.3]), 2), tx.plaster(np.full(3, 0.5), int(rng.integers(1 << 20)))
    for side in (-1, 1):
        s.box(period / 2, side * width * 0.22, 0, 0.45, 0.45, _HIGH_M, concrete, glow=_GLOW)
        for x in (0.0, period / 2):
            s.box(x + 0.06, side * width * 0.36, 0, 0.12, width * 0.26, 0.01, paint, glow=_GLOW)
    s.box(period / 2, 0, _HIGH_M - 0.35, 0.3, width, 0.35, concrete, glow=_GLOW)


def _storey(s: Surfaces, rng: np.random.Generator, height: float, width: float) -> None:
    """Four walls, a landing with a door and a picture, and two flights of stairs with a landing between them."""
    shell = s.at(width / 2, _DEEP_M / 2 - _LANDING_M)
    for wall, wide in enumerate((width, _DEEP_M) * 2):
        side = shell.at(0, 0, 0, wall * np.pi / 2).at(0, -(width + _DEEP_M - wide) / 2)
        paint = tx.plaster(colour(rng, saturation=(0.05, 0.45), value=(0.55, 0.9)), int(rng.integers(1 << 20)))
        side.rectangle([wide / 2, 0, 0], [-wide, 0, 0], [0, 0, height], paint, (0, 0), _GLOW)
    stone = tx.marble(
        colour(rng, saturation=(0.05, 0.3), value=(0.4, 0.7)), np.full(3, 0.4), int(rng.integers(1 << 20))
    )
    run, steps = _DEEP_M - 2 * _LANDING_M, 9
    for half in range(2):
        z, y = 0.5 * half * height, half * (_DEEP_M - _LANDING_M)
        s.box(width / 2, y - _LANDING_M / 2, z - 0.15, width, _LANDING_M, 0.15, stone, glow=_GLOW)
        for k in range(steps):
            y = run * (k + 0.5) / steps
            top = z + 0.5 * height * (k + 1) / steps - 0.15
            x = width * (0.25 + 0.5 * half)
            s.box(x, run - y if half else y, top, 0.45 * width, run / steps, 0.15, stone, glow=_GLOW)
    wood, frame = tx.wood(colour(rng, (0.03, 0.12), (0.3, 0.7), (0.3, 0.7)), 7), tx.plain(np.full(3, 0.2))
    s.box(0.7 * width, 0.03 - _LANDING_M, 0.01, 0.95, 0.05, 2.0, wood, glow=_GLOW)
    print_ = tx.picture(palette(rng, 5), int(rng.integers(1 << 20)), int(rng.integers(4)))
    s.at(width, 1.0, 0, np.pi / 2).box(0, 0.03, 0.6 * height, 0.8, 0.06, 0.5, frame, front=print_, glow=_GLOW)


def _unique_thing(s: Surfaces, rng: np.random.Generator, period: float, width: float) -> None:
    """A poster on a wall, or a crate or bin before it."""
    side, x, seed = rng.choice([-1, 1]), rng.uniform(0.7, period - 0.7), int(rng.integers(1 << 20))
    s = s.at(x, side * width / 2, 0, np.pi * (side > 0)).object("thing", "furniture")
    if rng.random() < 0.5:
        print_ = tx.picture(palette(rng, 5), seed, int(rng.integers(4)))
        wide, high = rng.uniform(0.4, 1.0, 2)
        s.box(0, 0.015, 1.5 - high / 2, wide, 0.03, high, tx.plain(np.full(3, 0.2)), front=print_, glow=_GLOW)
    else:
        (wide, deep), high = rng.uniform(0.3, 0.6, 2), rng.uniform(0.3, 1.0)
        tone = colour(rng, saturation=(0.3, 0.8), value=(0.3, 0.9))
        s.box(0, deep / 2 + 0.02, 0, wide, deep, high, tx.planks(tone, seed, 0.12, False), glow=_GLOW)


def _symmetric_room(s: Surfaces, rng: np.random.Generator, width: float, unique: float) -> None:
    """A square room whose four walls, or every two that face each other, are equal."""
    turns, looks = int(rng.choice([2, 4])), [int(v) for v in rng.integers(1 << 30, size=2)]
    tone = colour(rng, saturation=(0.05, 0.4), value=(0.35, 0.8))
    floor, plate = s.object("floor", "shell"), tx.plain(tone, 1)
    floor.rectangle([-width / 2, -width / 2, 0], [width, 0, 0], [0, width, 0], plate, (0, 0), _GLOW)
    white = tx.plain(np.full(3, 0.8), 1)
    floor.rectangle([-width / 2, width / 2, _HIGH_M], [width, 0, 0], [0, -width, 0], white, (0, 0), _GLOW)
    for wall in range(4):
        own = np.random.default_rng(looks[wall % 2 if turns == 2 else 0])
        side = s.at(0, 0, 0, wall * np.pi / 2).at(0, -width / 2).object("wall", "wall")
        paper = colour(own, saturation=(0.05, 0.45), value=(0.55, 0.9))
        paper_ = tx.wallpaper(paper, 0.7 * paper, int(own.integers(1 << 20)), int(own.integers(4)), 0.25)
        side.rectangle([width / 2, 0, 0], [-width, 0, 0], [0, 0, _HIGH_M], paper_, (0, 0), _GLOW)
        for x in own.uniform(-1.6, 1.6, 3):
            print_ = tx.picture(palette(own, 5), int(own.integers(1 << 20)), int(own.integers(4)))
            w, h = own.uniform(0.4, 0.9, 2)
            side.box(x, 0.015, 1.5 - h / 2, w, 0.03, h, tx.plain(np.full(3, 0.2)), front=print_, glow=_GLOW)
        wood = tx.wood(colour(own, (0.03, 0.12), (0.3, 0.7), (0.3, 0.7)), 7)
        side.box(own.uniform(-1, 1), 0.25, 0, own.uniform(0.6, 1.4), 0.45, own.uniform(0.5, 1.0), wood, glow=_GLOW)
    for _ in range(rng.poisson(4 * unique)):
        _unique_thing(s.at(0, 0, 0, rng.integers(4) * np.pi / 2).at(-width / 2, 0), rng, width, width)


def _hall_walk(place: Place, kind: Kind, start_m: float, count: int, seed: int) -> np.ndarray:
    """(count, 4, 4) camera poses of a walk along a hall, there and back, looking ahead and to the sides."""
    rng, out = np.random.default_rng([place.seed, seed, 63]), []
    phase, wide, storey_m = rng.uniform(0, 2 * np.pi, 3), _WIDTHS_M[kind], place.skin.corners[..., 2].max() / _STOREYS
    for i in range(count):
        way, floor_m = 2 * i / count, 0.0
        if kind == "symmetric room":
            angle = 2 * np.pi * i / count + phase[0]
            x, y, yaw = 0.3 * wide * np.cos(angle), 0.3 * wide * np.sin(angle), 2 * angle + phase[1]
        elif kind == "stairwell":
            up = (start_m + REACH_M * i / count) / STEP_M  # storeys
            back, along = divmod(2 * (up % 1), 1)
            x, y = (
                wide * (0.25 + 0.5 * back),
                (along if not back else 1 - along) * (_DEEP_M - _LANDING_M) - _LANDING_M / 2,
            )
            floor_m, yaw = up * storey_m, 14 * np.pi * i / count + phase[1]
        else:
            x = start_m + REACH_M * (way if way < 1 else 2 - way)
            y = 0.2 * wide * np.sin(5 * way + phase[0])
            yaw = np.pi * (way >= 1) + 1.1 * np.sin(9 * np.pi * way + phase[1])
        pitch = -0.05 + 0.3 * np.sin(11 * np.pi * way + phase[2])
        out.append(look_along(x, y, floor_m + 1.5 + 0.1 * np.sin(5 * way), yaw, pitch))
    return np.stack(out)


def hall_captures(
    place: Place,
    kind: Kind,
    count: int = 5,
    *,
    num_frames: int = 40,
    num_gaussians: int = 20_000,
    progress: Progress | None = None,
) -> list[DemoCapture]:
    """Capture a hall in stretches of `REACH_M` every `STEP_M`, each in its own random frame, in metres.

    A symmetric room is captured as a whole each time, a stairwell over two storeys.
    """
    rng = np.random.default_rng([place.seed, 67])
    starts = [2.0 + k * STEP_M + float(rng.uniform(-1, 1)) for k in range(count)]
    paths = [_hall_walk(place, kind, start, num_frames, k) for k, start in enumerate(starts)]
    return make_captures(
        place.seed,
        count,
        steps=0,
        num_frames=num_frames,
        num_gaussians=num_gaussians,
        place=place,
        paths=paths,
        far=FAR_M,
        progress=progress,
    )

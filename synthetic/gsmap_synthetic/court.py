"""A court: an outdoor place of 60 m and more between houses, with arcades, and walks through parts of it.

Columns, windows and pavement repeat; doors, signs, stains, trees and what stands about do not, or not exactly. What
walkers see lies 3 to 15 m away, several times as far as in a room, and Gaussians are as much larger.

Place frame: metres, z up, pavement at z = 0.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from gsmap.errors import ConfigError
from gsmap.types.progress import Progress
from gsmap_synthetic import textures as tx
from gsmap_synthetic.bake import bake
from gsmap_synthetic.capture import look_along
from gsmap_synthetic.furniture import colour, palette, timber
from gsmap_synthetic.make import DemoCapture, make_captures
from gsmap_synthetic.place import Place
from gsmap_synthetic.surfaces import Surfaces
from gsmap_synthetic.textures import Material

_SUN = np.array([0.35, 0.25, 0.9])
_GLOW = 0.85  # daylight: most of what a surface shows is its own colour under an even sky
_PAVED_M = 8.0
_HEAD_M = 1.6
_REACH_M = 15.0  # how much of the court, along it, one walk goes through
FAR_M = 18.0  # what lies farther is not captured: a phone's depth, or the parallax of a walk, tells no more


def make_court(
    seed: int = 0,
    *,
    length_m: float = 64.0,
    width_m: float = 26.0,
    texel_m: float = 0.03,
    progress: Callable[[float, str], None] | None = None,
) -> Place:
    """Build the court of a seed: houses along all four sides, arcades before the long ones, trees and street lamps.

    Args:
        seed: which court.
        length_m, width_m: between the houses, along x and y.
        texel_m: how fine the baked colours are.

    Raises:
        ConfigError: too small for a walk.
    """
    if length_m < 2 * _REACH_M or width_m < 12:
        raise ConfigError(f"a court is at least {2 * _REACH_M:.0f} m by 12 m, got {length_m} m by {width_m} m")
    rng, s = np.random.default_rng([seed, 31]), Surfaces()
    _pave(s, rng, length_m, width_m)
    stone = colour(rng, (0.05, 0.14), (0.05, 0.3), (0.55, 0.8))
    pitch, style = rng.uniform(2.4, 3.2), int(rng.integers(3))
    sides = [(length_m / 2, 0.0, 0.0, length_m), (length_m / 2, width_m, np.pi, length_m)]
    sides += [(length_m, width_m / 2, np.pi / 2, width_m), (0.0, width_m / 2, 1.5 * np.pi, width_m)]
    for side, (x, y, yaw, along_m) in enumerate(sides):
        at = s.at(x, y, 0, yaw)
        _houses(at, rng, along_m, _sunlit(yaw))
        if side < 2:
            _arcade(at.at(0, rng.uniform(1.8, 2.4)), rng, along_m, pitch, style, stone, _sunlit(yaw))
    _plant(s, rng, length_m, width_m)
    skin = bake(s, texel_m=texel_m, progress=progress)
    return Place(seed, (), (), skin, s)


def _sunlit(yaw_rad: float) -> float:
    """How bright a wall is that faces into the court from a side turned by ``yaw_rad``."""
    facing = np.array([-np.sin(yaw_rad), np.cos(yaw_rad), 0.0])
    return float(0.75 + 0.25 * facing @ _SUN)


def _lit(material: Material, brightness: float) -> Material:
    return lambda u, v, size: np.clip(material(u, v, size) * np.float32(brightness), 0, 1)


def _pave(s: Surfaces, rng: np.random.Generator, length: float, width: float) -> None:
    """Slabs of one kind, with worn and mended patches, a band of another stone, and drains."""
    ground, accent = (colour(rng, (0.04, 0.16), (0.03, 0.25), (0.35, 0.7)) for _ in range(2))
    slabs = tx.tiles(ground, accent, int(rng.integers(1 << 20)), rng.uniform(0.45, 0.8), int(rng.integers(2)))
    s = s.object("pavement", "shell")
    for x in np.arange(0, length, _PAVED_M):
        for y in np.arange(0, width, _PAVED_M):
            w, d = min(_PAVED_M, length - x), min(_PAVED_M, width - y)
            s.rectangle([x, y, 0], [w, 0, 0], [0, d, 0], slabs, (x, y), _GLOW)
    for _ in range(int(length * width / 28)):
        w, d = rng.uniform(0.5, 2.5, 2)
        x, y = rng.uniform(0.5, length - w - 0.5), rng.uniform(0.5, width - d - 0.5)
        kind = int(rng.integers(3))
        tone, seed = colour(rng, (0.0, 0.2), (0.0, 0.35), (0.2, 0.75)), int(rng.integers(1 << 20))
        worn = tx.marble(tone, 0.5 * tone, seed) if kind == 1 else tx.fabric(tone, 0.5 * tone, seed, 1)
        patch = tx.plaster(tone, seed) if kind == 0 else worn
        s.box(x, y, 0, w, d, 0.012, patch, glow=_GLOW)


def _houses(s: Surfaces, rng: np.random.Generator, along: float, light: float) -> None:
    """Houses side by side along x, facing +y: each its own colour and height, all with windows at one pitch."""
    x, k = -along / 2, 0
    while x < along / 2 - 1e-6:
        width = min(rng.uniform(5.5, 9.5), along / 2 - x)
        width = along / 2 - x if along / 2 - x - width < 4 else width
        height, floors = rng.uniform(7.0, 10.0), 3
        tone, seed = colour(rng, saturation=(0.08, 0.5), value=(0.5, 0.9)), int(rng.integers(1 << 20))
        brick = tx.tiles(tone, 0.7 * tone, seed, rng.uniform(0.18, 0.3), 0)
        front = _lit(tx.plaster(tone, seed) if rng.random() < 0.6 else brick, light)
        house = s.at(x + width / 2, 0).object("house", "shell")
        house.rectangle([width / 2, 0, 0], [-width, 0, 0], [0, 0, height], front, (-x, 11.0 * k), _GLOW)
        plinth = _lit(tx.marble(0.6 * tone, 0.3 * tone, seed + 1), light)
        house.box(0, 0.05, 0, width, 0.1, rng.uniform(0.4, 0.8), plinth, glow=_GLOW)
        for floor in range(1, floors):
            house.box(0, 0.08, floor * height / floors - 0.1, width, 0.16, 0.14, plinth, glow=_GLOW)
        house.box(0, 0.2, height - 0.3, width + 0.1, 0.4, 0.3, plinth, glow=_GLOW)
        _openings(house, rng, width, height / floors, floors, light)
        x, k = x + width, k + 1


def _openings(s: Surfaces, rng: np.random.Generator, width: float, storey: float, floors: int, light: float) -> None:
    """Windows in columns; at the bottom doors, shop windows and signs instead, no two houses alike."""
    count = max(1, int(width // 1.9))
    wide, high = rng.uniform(0.8, 1.1), rng.uniform(1.2, 1.5)
    glass, frame = (
        tx.plain(colour(rng, (0.5, 0.65), (0.1, 0.4), (0.1, 0.3)), 3),
        _lit(tx.plain(np.full(3, 0.7), 5), light),
    )
    shutter = _lit(tx.wood(colour(rng, value=(0.2, 0.6)), int(rng.integers(99)), True), light)
    has_shutters = rng.random() < 0.5
    for k in range(count):
        x = (k + 0.5) * width / count - width / 2
        for floor in range(1, floors):
            z = floor * storey + 0.55
            s.box(x, 0.03, z, wide + 0.16, 0.06, high + 0.16, frame, glow=_GLOW)
            s.box(x, 0.035, z + 0.08, wide, 0.07, high, glass, glow=_GLOW)
            if has_shutters:
                open_m = rng.uniform(0.35, 0.5)
                for side in (-1, 1):
                    s.box(x + side * (wide / 2 + open_m / 2), 0.05, z, open_m, 0.1, high + 0.1, shutter, glow=_GLOW)
        kind, z, seed = int(rng.integers(4)), 0.0, int(rng.integers(1 << 20))
        if kind == 0:
            door = _lit(tx.wood(timber(rng), seed, True), light)
            s.box(x, 0.06, 0, 1.1, 0.12, 2.3, door, glow=_GLOW)
        elif kind == 1:
            shop = tx.picture(palette(rng, 6), seed, int(rng.integers(4)))
            s.box(x, 0.06, 0.6, 1.4, 0.12, 1.7, frame, front=_lit(shop, light), glow=_GLOW)
        else:
            s.box(x, 0.03, 0.9, wide, 0.06, 1.3, frame, front=glass, glow=_GLOW)
        if rng.random() < 0.4:
            sign = tx.picture(palette(rng, 5), seed + 1, 1 + int(rng.integers(2)))
            s.box(
                x,
                0.1,
                2.45,
                rng.uniform(0.8, 1.5),
                0.2,
                rng.uniform(0.3, 0.6),
                frame,
                front=_lit(sign, light),
                glow=_GLOW,
            )


def _arcade(
    s: Surfaces, rng: np.random.Generator, along: float, pitch: float, style: int, stone: np.ndarray, light: float
) -> None:
    """Columns at one pitch, all alike, and the beam they carry."""
    shaft, cap = _lit(tx.marble(stone, 0.6 * stone, 7), light), _lit(tx.plaster(0.9 * stone, 8), light)
    s = s.object("arcade", "shell")
    height = 3.4
    for k in range(int(along // pitch)):
        x = (k + 0.5) * pitch - along / 2
        if style:
            sides, radius = (14, 0.24) if style == 1 else (8, 0.28)
            profile = [(radius + 0.08, 0), (radius + 0.08, 0.3), (radius, 0.4), (0.8 * radius, height - 0.3)]
            s.lathe(x, 0, 0, [*profile, (radius + 0.1, height)], shaft, sides, _GLOW)
        else:
            s.box(x, 0, 0, 0.5, 0.5, height, shaft, glow=_GLOW)
    s.box(0, 0, height, along, 0.6, 0.5, cap, glow=_GLOW)


def _plant(s: Surfaces, rng: np.random.Generator, length: float, width: float) -> None:
    """Trees, street lamps, benches, tubs and a fountain in the middle, clear of the walks."""
    lamp_x = np.arange(6.0, length - 3, rng.uniform(9, 12))
    iron = tx.plain(np.full(3, 0.06), 2)
    for x in lamp_x:
        for y in (0.27 * width, 0.73 * width):
            post = s.object("street lamp", "lamp")
            post.lathe(x, y, 0, [(0.12, 0), (0.12, 0.5), (0.06, 0.6), (0.05, 3.6)], iron, 8, 0.5)
            post.lathe(x, y, 3.6, [(0.1, 0), (0.2, 0.4), (0.05, 0.5)], tx.plain(np.full(3, 0.8), 4), 8, 1.0)
            post.lamp(x, y, 4.3, np.full(3, 9.0), 0.2)
    for _ in range(int(length / 6)):
        x, y = rng.uniform(3, length - 3), rng.choice([0.3, 0.7]) * width + rng.uniform(-1.0, 1.0)
        what = rng.random()
        if what < 0.5:
            _tree(s.at(x, y), rng)
        elif what < 0.75:
            bench = s.at(x, y, 0, rng.uniform(0, np.pi)).object("bench", "furniture")
            board = tx.planks(timber(rng), int(rng.integers(99)), 0.1, False)
            bench.box(0, 0, 0.4, 1.7, 0.45, 0.06, board, glow=_GLOW)
            for side in (-0.7, 0.7):
                bench.box(side, 0, 0, 0.1, 0.4, 0.4, iron, glow=_GLOW)
        else:
            tub = s.at(x, y).object("tub", "furniture")
            clay = tx.plaster(colour(rng, (0.02, 0.1), (0.3, 0.7), (0.4, 0.8)), int(rng.integers(99)))
            tub.lathe(0, 0, 0, [(0.3, 0), (0.5, 0.6), (0.45, 0.62), (0.2, 0.6)], clay, 12, _GLOW)
            leaves = tx.leaf(colour(rng, (0.2, 0.4), (0.4, 0.9), (0.2, 0.6)), int(rng.integers(99)))
            tub.lathe(0, 0, 0.55, [(0.2, 0), (0.5, 0.4), (0.3, 0.9), (0.0, 1.0)], leaves, 9, _GLOW)
    x, stone = length * rng.uniform(0.3, 0.7), tx.marble(np.full(3, 0.5), np.full(3, 0.25), 3)
    basin = s.at(x, width / 2).object("fountain", "shell")
    basin.lathe(0, 0, 0, [(1.5, 0), (1.6, 0.5), (1.4, 0.55), (1.35, 0.3), (0, 0.3)], stone, 16, _GLOW)
    basin.lathe(0, 0, 0.3, [(0.25, 0), (0.15, 1.2), (0.7, 1.5), (0.0, 1.4)], stone, 12, _GLOW)


def _tree(s: Surfaces, rng: np.random.Generator) -> None:
    """A trunk and a crown of lumps."""
    s = s.object("tree", "furniture")
    s.lathe(0, 0, 0, [(0.18, 0), (0.13, 1.0), (0.1, 2.8)], tx.wood(timber(rng) * 0.6, 5, True), 8, _GLOW)
    green = colour(rng, (0.18, 0.4), (0.4, 0.9), (0.25, 0.65))
    for k in range(int(rng.integers(5, 9))):
        x, y, z = rng.normal(0, 0.55, 3)
        r = rng.uniform(0.45, 0.9)
        profile = [(0.0, -r), (0.7 * r, -0.7 * r), (r, 0), (0.7 * r, 0.7 * r), (0.0, r)]
        leaves = tx.leaf(green * rng.uniform(0.7, 1.3), int(rng.integers(1 << 20)) + k)
        s.lathe(x, y, 3.4 + z, profile, leaves, 8, _GLOW)


def stroll(place: Place, at_m: float, count: int, seed: int = 0, *, width_m: float = 26.0) -> np.ndarray:
    """(count, 4, 4) camera poses of a walk round the part of a court about ``x = at_m``, looking about twice.

    Args:
        place: a court.
        at_m: middle of the walk along the court, kept clear of its ends.
        width_m: of the court.
    """
    rng = np.random.default_rng([place.seed, seed, 33])
    length = float(place.skin.corners[..., 0].max())
    low, high = max(at_m - _REACH_M / 2, 4.0), min(at_m + _REACH_M / 2, length - 4.0)
    middle, radii = np.array([(low + high) / 2, width_m / 2]), np.array([(high - low) / 2, width_m / 2 - 5.5])
    radii = radii * rng.uniform(0.8, 1.0, 2)
    phase, turn = float(rng.uniform(0, 2 * np.pi)), float(rng.choice([-1.0, 1.0]))
    yaw0, tilt0 = (float(x) for x in rng.uniform(0, 2 * np.pi, 2))
    out = []
    for i in range(count):
        angle = phase + turn * 2 * np.pi * i / count
        x, y = middle + radii * [np.cos(angle), np.sin(angle)]
        yaw = yaw0 + turn * 4 * np.pi * i / count + 0.25 * np.sin(3 * angle)
        pitch = 0.02 + 0.2 * np.sin(tilt0 + 5 * angle)
        out.append(look_along(x, y, _HEAD_M + 0.12 * np.sin(2 * angle + tilt0), yaw, pitch))
    return np.stack(out)


def court_captures(
    seed: int = 0,
    num_captures: int = 6,
    *,
    num_frames: int = 48,
    num_gaussians: int = 60_000,
    steps: int = 0,
    progress: Progress | None = None,
    **others: Any,
) -> list[DemoCapture]:
    """Build the court of ``seed`` and capture it, each walk in its own random frame, in metres.

    Args:
        others: of `gsmap_synthetic.make_captures`.
    """
    place = make_court(seed)
    paths = [stroll(place, at, num_frames, k) for k, at in enumerate(walks(place, num_captures))]
    return make_captures(
        seed,
        num_captures,
        steps=steps,
        num_frames=num_frames,
        num_gaussians=num_gaussians,
        place=place,
        paths=paths,
        far=FAR_M,
        progress=progress,
        **others,
    )


def cloudy(seed: int) -> Callable[[np.ndarray], np.ndarray]:
    """The colours (n, 3) of a sky of a seed by direction (n, 3): blue to white, with clouds."""
    rng = np.random.default_rng([seed, 35])
    top, cover = np.array([0.3, 0.5, 0.85]) * rng.uniform(0.7, 1.1), rng.uniform(-0.2, 0.4)

    def look(directions: np.ndarray) -> np.ndarray:
        x, y, z = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).T
        u, v = x / (z.clip(0) + 0.2), y / (z.clip(0) + 0.2)
        cloud = np.zeros(len(z))
        for k in range(3):
            cloud += 0.5**k * (tx.noise(u, v, 0.8 / 2**k, seed + k) - 0.5)
        white = np.clip(0.4 * (1 - z.clip(0)) + 1.2 * (cloud + cover), 0, 1)[:, None]
        out: np.ndarray = ((1 - white) * top + white * 0.95).astype(np.float32)
        return out

    return look


def walks(place: Place, captures: int) -> list[float]:
    """Middles of walks along a court, in random order: neighbours share from most to little of what they see."""
    rng = np.random.default_rng([place.seed, 34])
    length = float(place.skin.corners[..., 0].max())
    at = np.linspace(0.15, 0.85, captures) + rng.uniform(-0.06, 0.06, captures)
    return [float(x) for x in rng.permutation(at * length)]

"""Furniture: each piece is one function that adds its surfaces in a local frame.

The frame of a piece: x along the wall, y away from the wall (0 at the wall), z up, origin at the middle of its back. A
piece gets the width and depth the placer chose for it, and its own random generator for everything else.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gsmap_synthetic import textures as tx
from gsmap_synthetic.surfaces import Surfaces


def colour(rng, hue=(0.0, 1.0), saturation=(0.2, 0.8), value=(0.2, 0.8)) -> np.ndarray:
    """A random linear-light colour within ranges of hue, saturation and (display) value."""
    return np.array(colorsys.hsv_to_rgb(rng.uniform(*hue) % 1, rng.uniform(*saturation), rng.uniform(*value))) ** 2.2


def timber(rng) -> np.ndarray:
    return colour(rng, (0.04, 0.11), (0.25, 0.75), (0.35, 0.85))


def palette(rng, count: int = 5) -> np.ndarray:
    hue = rng.uniform()
    return np.stack(
        [colour(rng, (hue + 0.31 * k, hue + 0.31 * k + 0.12), (0.25, 0.9), (0.2, 0.95)) for k in range(count)]
    )


def _seed(rng) -> int:
    return int(rng.integers(1 << 20))


def _wood(rng, tone=None, along_v=False):
    return tx.wood(timber(rng) if tone is None else tone, _seed(rng), along_v)


def _plain(rng, **ranges):
    return tx.plain(colour(rng, **ranges), _seed(rng))


def _cloth(rng):
    return tx.fabric(colour(rng), colour(rng), _seed(rng), int(rng.integers(4)), rng.uniform(0.1, 0.3))


def _books(s: Surfaces, rng, x0, x1, y, z, room_m) -> None:
    """A row of books from x0 to x1 whose backs stand at y; some gaps, some leaning away, some lying ornaments."""
    x = x0
    while x < x1 - 0.05:
        if rng.random() < 0.10:
            if x < x1 - 0.2 and rng.random() < 0.6:
                radius = rng.uniform(0.04, 0.07)
                h = rng.uniform(0.12, min(0.24, room_m))
                profile = [(radius * 0.6, 0), (radius, h * 0.4), (radius * 0.4, h * 0.8), (radius * 0.6, h)]
                s.lathe(x + 0.1, y + 0.12, z, profile, _plain(rng, saturation=(0.3, 0.9)), 8)
            x += 0.2
            continue
        thick = min(rng.uniform(0.025, 0.07), x1 - x)
        high = rng.uniform(0.6, 0.97) * room_m
        deep = rng.uniform(0.14, 0.22)
        spine = tx.book(colour(rng, (0, 1), (0.2, 0.95), (0.15, 0.9)), colour(rng, value=(0.6, 1.0)), _seed(rng))
        s.box(x + thick / 2, y + deep / 2, z, thick * 0.96, deep, high, tx.plain(np.full(3, 0.55)), front=spine)
        x += thick


def bookshelf(s: Surfaces, rng, w, d) -> None:
    frame, h = _wood(rng, along_v=True), rng.uniform(1.7, 2.15)
    shelves = int(rng.integers(4, 7))
    pitch = (h - 0.1) / shelves
    s.box(-w / 2 + 0.0125, d / 2, 0, 0.025, d, h, frame)
    s.box(w / 2 - 0.0125, d / 2, 0, 0.025, d, h, frame)
    s.box(0, 0.01, 0, w - 0.05, 0.02, h, frame)
    for k in range(shelves + 1):
        s.box(0, d / 2, 0.07 + k * pitch, w - 0.05, d, 0.025, frame)
        if k < shelves:
            _books(s, rng, -w / 2 + 0.04, w / 2 - 0.04, 0.04, 0.095 + k * pitch, pitch - 0.06)


def wardrobe(s: Surfaces, rng, w, d) -> None:
    tone, h = timber(rng), rng.uniform(1.9, 2.2)
    doors = 2 + int(w > 1.4)
    s.box(0, d / 2, 0.06, w, d, h, _wood(rng, tone, True))
    for k in range(doors):
        x, dw = -w / 2 + (k + 0.5) * w / doors, w / doors
        s.box(x, d + 0.01, 0.1, dw - 0.03, 0.02, h - 0.08, _wood(rng, tone * rng.uniform(0.8, 1.2), True))
        inset = _wood(rng, tone * rng.uniform(0.5, 0.8), True) if rng.random() < 0.7 else _plain(rng)
        s.box(x, d + 0.022, 0.25, dw - 0.16, 0.006, h - 0.45, inset)
        s.box(x + (0.4 if k % 2 == 0 else -0.4) * dw, d + 0.035, 1.0, 0.02, 0.03, 0.16, tx.plain(np.full(3, 0.6)))


def bed(s: Surfaces, rng, w, d) -> None:
    tone = timber(rng)
    sheet, blanket = _cloth(rng), _cloth(rng)
    s.box(0, 0.03, 0, w, 0.06, rng.uniform(0.8, 1.1), _wood(rng, tone))
    s.box(0, d / 2, 0.12, w, d, 0.2, _wood(rng, tone))
    s.box(0, d / 2 + 0.03, 0.32, w - 0.06, d - 0.1, 0.2, tx.fabric(np.full(3, 0.7), np.full(3, 0.7), _seed(rng), 0))
    s.box(0, d / 2 + 0.3, 0.33, w - 0.02, d - 0.62, 0.22, blanket)
    s.box(0, d - 0.45, 0.54, w, 0.5, 0.04, sheet)
    for k in range(2):
        x = (k - 0.5) * 0.48 * w
        s.box(x, 0.30, 0.52, 0.4 * w, 0.36, 0.11, _cloth(rng))


def drawers(s: Surfaces, rng, w, d) -> None:
    tone, h, rows = timber(rng), rng.uniform(0.75, 1.05), int(rng.integers(3, 5))
    s.box(0, d / 2, 0.05, w, d, h, _wood(rng, tone))
    for k in range(rows):
        face = _wood(rng, tone * rng.uniform(0.7, 1.25))
        s.box(0, d + 0.008, 0.08 + k * (h - 0.05) / rows, w - 0.05, 0.016, (h - 0.05) / rows - 0.03, face)
        for x in (-w / 4, w / 4):
            s.box(x, d + 0.03, 0.05 + (k + 0.5) * (h - 0.05) / rows, 0.1, 0.03, 0.02, tx.plain(np.full(3, 0.5)))
    _ornaments(s, rng, w, d, h + 0.05)


def _ornaments(s: Surfaces, rng, w, d, z) -> None:
    """A few things standing about on a top of width w and depth d at height z."""
    for x in np.linspace(-w / 2 + 0.15, w / 2 - 0.15, max(2, int(w / 0.35))):
        kind, y = rng.integers(5), d * rng.uniform(0.35, 0.65)
        if kind == 0:
            r, h = rng.uniform(0.04, 0.08), rng.uniform(0.15, 0.32)
            s.lathe(
                x,
                y,
                z,
                [(r * 0.7, 0), (r, h * 0.35), (r * 0.35, h * 0.75), (r * 0.6, h)],
                _plain(rng, saturation=(0.4, 0.9)),
            )
        elif kind == 1:
            size = rng.uniform(0.16, 0.26)
            frame = tx.picture(palette(rng), _seed(rng), int(rng.integers(4)))
            s.box(x, y - 0.08, z, size, 0.03, size * 1.25, tx.plain(np.full(3, 0.1)), front=frame)
        elif kind == 2:
            for k in range(int(rng.integers(2, 5))):
                s.box(
                    x + rng.uniform(-0.01, 0.01),
                    y,
                    z + 0.03 * k,
                    0.2,
                    0.15,
                    0.03,
                    tx.plain(colour(rng, saturation=(0.3, 0.9)), _seed(rng)),
                )
        elif kind == 3:
            r = rng.uniform(0.07, 0.11)
            s.lathe(x, y, z, [(r * 0.5, 0), (r, r * 0.9), (r * 0.9, r * 0.9), (0, 0.03)], _plain(rng))


def desk(s: Surfaces, rng, w, d) -> None:
    tone = timber(rng)
    s.box(0, d / 2, 0.71, w, d, 0.035, _wood(rng, tone))
    s.box(-w / 2 + 0.2, d / 2, 0, 0.36, d - 0.08, 0.71, _wood(rng, tone * 0.8))
    for x, y in ((w / 2 - 0.05, 0.06), (w / 2 - 0.05, d - 0.06)):
        s.box(x, y, 0, 0.05, 0.05, 0.71, _wood(rng, tone, True))
    screen = tx.picture(palette(rng), _seed(rng), int(rng.integers(3)))
    s.box(0.1, 0.14, 0.80, 0.55, 0.03, 0.34, tx.plain(np.full(3, 0.03)), front=screen)
    s.box(0.1, 0.12, 0.745, 0.08, 0.05, 0.1, tx.plain(np.full(3, 0.05)))
    s.box(0.1, 0.42, 0.745, 0.42, 0.14, 0.02, tx.tiles(np.full(3, 0.1), np.full(3, 0.3), _seed(rng), 0.022, 0))
    _books(s, rng, -w / 2 + 0.04, -0.25, 0.06, 0.745, 0.3)
    chair(s.at(0.1, d + 0.1, 0, np.pi + rng.uniform(-0.5, 0.5)), rng)


def chair(s: Surfaces, rng, tone=None, seat=None) -> None:
    tone = timber(rng) if tone is None else tone
    legs, seat = _wood(rng, tone, True), seat or _cloth(rng)
    s.box(0, 0, 0.43, 0.42, 0.42, 0.05, legs, top=seat)
    for x in (-0.18, 0.18):
        s.box(x, -0.18, 0, 0.04, 0.04, 0.95, legs)
        s.box(x, 0.18, 0, 0.04, 0.04, 0.43, legs)
    s.box(0, -0.19, 0.62, 0.34, 0.025, 0.28, legs, front=seat)


def lone_chair(s: Surfaces, rng, w, d) -> None:
    chair(s.at(0, d / 2), rng)


def sofa(s: Surfaces, rng, w, d) -> None:
    cloth = _cloth(rng)
    s.box(0, d / 2, 0.08, w, d, 0.32, cloth)
    s.box(0, 0.12, 0.4, w, 0.24, rng.uniform(0.35, 0.5), cloth)
    for x in (-w / 2 + 0.1, w / 2 - 0.1):
        s.box(x, d / 2, 0.4, 0.2, d, 0.2, cloth)
    seats = max(1, round((w - 0.4) / 0.65))
    for k in range(seats):
        x = -w / 2 + 0.2 + (k + 0.5) * (w - 0.4) / seats
        s.box(x, d / 2 + 0.1, 0.4, (w - 0.42) / seats, d - 0.25, 0.12, cloth)
        if rng.random() < 0.75:
            s.at(x + rng.uniform(-0.1, 0.1), 0.36, 0.52, rng.uniform(-0.4, 0.4)).box(
                0, 0, 0, 0.4, 0.14, 0.36, _cloth(rng)
            )


def sideboard(s: Surfaces, rng, w, d) -> None:
    tone = timber(rng)
    s.box(0, d / 2, 0.08, w, d, 0.42, _wood(rng, tone))
    for k in range(3):
        s.box(
            -w / 2 + (k + 0.5) * w / 3,
            d + 0.008,
            0.11,
            w / 3 - 0.03,
            0.016,
            0.35,
            _wood(rng, tone * rng.uniform(0.5, 1.4)),
        )
    screen = tx.picture(palette(rng), _seed(rng), int(rng.integers(2)))
    s.box(0, 0.16, 0.56, 0.62 * w, 0.05, 0.36 * w, tx.plain(np.full(3, 0.02)), front=screen)
    s.box(0, 0.16, 0.5, 0.3, 0.14, 0.06, tx.plain(np.full(3, 0.03)))
    for x in (-0.42 * w, 0.42 * w):
        _ornaments(s.at(x, 0), rng, 0.3, d, 0.5)


def kitchen_row(s: Surfaces, rng, w, d) -> None:
    fronts, stone = colour(rng, saturation=(0.1, 0.7)), colour(rng, saturation=(0.02, 0.2), value=(0.3, 0.9))
    units = max(2, round(w / 0.6))
    s.box(0, d / 2, 0.1, w, d - 0.04, 0.76, tx.plain(fronts * 0.6))
    s.box(0, d / 2, 0.86, w, d + 0.02, 0.04, tx.marble(stone, stone * 0.25, _seed(rng)))
    back = tx.tiles(
        colour(rng, saturation=(0.05, 0.4), value=(0.6, 0.95)),
        colour(rng),
        _seed(rng),
        rng.uniform(0.1, 0.16),
        int(rng.integers(3)),
    )
    s.box(0, 0.01, 0.9, w, 0.02, 0.55, back)
    oven, sink = rng.permutation(units)[:2]
    for k in range(units):
        x, uw = -w / 2 + (k + 0.5) * w / units, w / units
        face = tx.plain(np.full(3, 0.04)) if k == oven else tx.wood(fronts * rng.uniform(0.85, 1.1), _seed(rng), True)
        s.box(x, d - 0.01, 0.12, uw - 0.015, 0.02, 0.72, face)
        s.box(x, d + 0.02, 0.76, uw * 0.6, 0.03, 0.02, tx.plain(np.full(3, 0.55)))
        if k == oven:
            s.box(x, d / 2, 0.90, uw * 0.85, d * 0.8, 0.012, tx.tiles(np.full(3, 0.02), np.full(3, 0.3), 3, 0.2, 2))
            s.lathe(
                x + 0.1,
                d / 2,
                0.912,
                [(0.1, 0), (0.1, 0.14), (0.02, 0.16), (0, 0.16)],
                _plain(rng, saturation=(0.3, 0.9)),
            )
        elif k == sink:
            s.box(x, d / 2, 0.90, uw * 0.75, d * 0.6, 0.006, tx.plain(np.full(3, 0.25)))
            s.lathe(x, 0.1, 0.9, [(0.02, 0), (0.015, 0.3), (0.0, 0.3)], tx.plain(np.full(3, 0.6)), 6)
        else:
            _ornaments(s.at(x, 0.05), rng, 0.3, d * 0.7, 0.90)
        if rng.random() < 0.75:
            s.box(x, 0.17, 1.45, uw - 0.01, 0.34, 0.65, tx.wood(fronts * rng.uniform(0.7, 1.2), _seed(rng), True))


def fridge(s: Surfaces, rng, w, d) -> None:
    body, h = tx.plain(colour(rng, saturation=(0.0, 0.6), value=(0.5, 0.95)), _seed(rng)), rng.uniform(1.5, 1.85)
    s.box(0, d / 2, 0.03, w, d, h, body)
    s.box(0, d + 0.004, 0.62, w, 0.008, 0.015, tx.plain(np.full(3, 0.1)))
    for _ in range(6):
        note = tx.picture(palette(rng), _seed(rng), int(rng.integers(3)))
        s.box(rng.uniform(-0.2, 0.2), d + 0.003, rng.uniform(0.8, h - 0.2), rng.uniform(0.06, 0.14), 0.004, 0.12, note)


def dining_table(s: Surfaces, rng, w, d) -> None:
    """Free-standing: y runs from 0 to d across the piece, chairs included in the footprint."""
    tone, chairs = timber(rng), timber(rng)
    s = s.at(0, d / 2)
    tw, td = w - 0.5, d - 0.9
    s.box(0, 0, 0.71, tw, td, 0.035, _wood(rng, tone))
    for x in (-tw / 2 + 0.06, tw / 2 - 0.06):
        for y in (-td / 2 + 0.06, td / 2 - 0.06):
            s.box(x, y, 0, 0.06, 0.06, 0.71, _wood(rng, tone * 0.8, True))
    seat = _cloth(rng)
    for x in np.linspace(-tw / 2 + 0.35, tw / 2 - 0.35, max(1, int(tw / 0.65))):
        for y, yaw in ((-td / 2 - 0.1, 0.0), (td / 2 + 0.1, np.pi)):
            chair(s.at(x + rng.uniform(-0.06, 0.06), y, 0, yaw + rng.uniform(-0.35, 0.35)), rng, chairs, seat)
    s.box(rng.uniform(-0.1, 0.1), 0, 0.745, tw * 0.75, 0.3, 0.006, _cloth(rng))
    s.lathe(rng.uniform(-0.2, 0.2), 0, 0.75, [(0.07, 0), (0.15, 0.08), (0.14, 0.08), (0, 0.04)], _plain(rng))
    for _ in range(4):
        r = 0.11
        s.lathe(
            rng.uniform(-tw / 2.6, tw / 2.6),
            rng.choice([-1, 1]) * td * 0.3,
            0.75,
            [(r * 0.6, 0), (r, 0.02), (0, 0.012)],
            _plain(rng, value=(0.6, 0.95)),
        )


def coffee_table(s: Surfaces, rng, w, d) -> None:
    s.box(0, d / 2, 0.36, w, d, 0.04, _wood(rng))
    for x in (-w / 2 + 0.05, w / 2 - 0.05):
        s.box(x, d / 2, 0, 0.05, d - 0.06, 0.36, _wood(rng))
    for _ in range(3):
        cover = tx.picture(palette(rng), _seed(rng), int(rng.integers(4)))
        s.at(rng.uniform(-w / 3, w / 3), d * rng.uniform(0.3, 0.7), 0.4, rng.uniform(-1, 1)).box(
            0, 0, 0, 0.21, 0.28, 0.015, cover
        )
    _ornaments(s, rng, w, d, 0.4)


def armchair(s: Surfaces, rng, w, d) -> None:
    sofa(s, rng, w, d)


def plant(s: Surfaces, rng, w, d) -> None:
    y, tall = d / 2, rng.uniform(0.7, 1.5)
    s.lathe(0, y, 0, [(0.11, 0), (0.17, 0.3), (0.15, 0.3), (0, 0.26)], _plain(rng))
    s.lathe(0, y, 0.26, [(0.02, 0), (0.012, tall - 0.3), (0, tall - 0.3)], tx.plain(np.array([0.12, 0.07, 0.03])), 6)
    green = tx.leaf(colour(rng, (0.22, 0.4), (0.4, 0.9), (0.3, 0.65)), _seed(rng))
    for _ in range(26):
        yaw, lift, long = rng.uniform(0, 2 * np.pi), rng.uniform(-0.4, 0.9), rng.uniform(0.2, 0.38)
        out = np.array([np.cos(yaw) * np.cos(lift), np.sin(yaw) * np.cos(lift), np.sin(lift)]) * long
        wide = np.array([-np.sin(yaw), np.cos(yaw), 0]) * long * 0.3
        root = np.array([0, y, rng.uniform(0.4, 1) * tall])
        s.quad([root - wide * 0.3, root + wide * 0.3, root + out * 0.6 + wide, root + out * 0.6 - wide], green)
        tip = root + out - [0, 0, 0.06]
        s.quad([root + out * 0.6 - wide, root + out * 0.6 + wide, tip + wide * 0.1, tip - wide * 0.1], green)


def floor_lamp(s: Surfaces, rng, w, d) -> None:
    y, h = d / 2, rng.uniform(1.35, 1.65)
    s.lathe(0, y, 0, [(0.15, 0), (0.14, 0.03), (0.012, 0.04), (0.012, h)], tx.plain(np.full(3, 0.08)), 8)
    shade = colour(rng, (0.05, 0.15), (0.1, 0.6), (0.8, 1.0))
    s.lathe(0, y, h - 0.05, [(0.2, 0), (0.13, 0.28)], tx.fabric(shade, shade, _seed(rng), 0), 12, glow=0.9)
    s.lamp(0, y, h - 0.12, shade * 1.1, 0.12)
    s.lamp(0, y, h + 0.3, shade * 0.9, 0.12)


def bathtub(s: Surfaces, rng, w, d) -> None:
    white = tx.plain(np.full(3, 0.75), _seed(rng))
    s.box(
        0,
        d / 2,
        0,
        w,
        d,
        0.55,
        tx.tiles(colour(rng, saturation=(0.1, 0.5)), colour(rng), _seed(rng), 0.12, 2),
        top=white,
    )
    s.box(0, d / 2, 0.552, w - 0.2, d - 0.2, 0.004, tx.plain(np.array([0.3, 0.45, 0.5]), _seed(rng)))
    s.box(0.3 * w, d / 2, 0.555, 0.3, 0.24, 0.05, _cloth(rng))


def basin(s: Surfaces, rng, w, d) -> None:
    s.box(0, d / 2, 0, w, d, 0.78, _wood(rng))
    s.box(0, d / 2, 0.78, w + 0.04, d + 0.04, 0.08, tx.plain(np.full(3, 0.8), _seed(rng)))
    s.box(0, 0.02, 1.15, w * 0.8, 0.03, 0.75, _wood(rng), front=tx.picture(palette(rng), _seed(rng), 0))
    _ornaments(s, rng, w, d, 0.86)


@dataclass(frozen=True)
class Piece:
    """A kind of furniture: how to build it and the footprints it comes in (width along the wall, depth).

    ``symmetry`` says which turns about its middle leave it nearly as it is, see `PlaceObject`.
    """

    build: Callable[[Surfaces, np.random.Generator, float, float], None]
    width_m: tuple[float, float]
    depth_m: tuple[float, float]
    against_wall: bool = True
    tall: bool = False
    covers_wall: bool = False  # Pictures keep clear of it.
    symmetry: str = "none"
    small: bool = False


PIECES = {
    "armchair": Piece(armchair, (0.85, 0.95), (0.8, 0.9)),
    "basin": Piece(basin, (0.6, 0.9), (0.45, 0.5), tall=True, covers_wall=True),
    "bathtub": Piece(bathtub, (1.5, 1.7), (0.7, 0.8)),
    "bed": Piece(bed, (1.2, 1.7), (2.0, 2.1)),
    "bookshelf": Piece(bookshelf, (0.8, 1.4), (0.3, 0.34), tall=True, covers_wall=True),
    "chair": Piece(lone_chair, (0.42, 0.42), (0.42, 0.42), against_wall=False),
    "coffee table": Piece(coffee_table, (0.8, 1.1), (0.5, 0.6), against_wall=False, symmetry="half"),
    "desk": Piece(desk, (1.2, 1.5), (0.6, 0.7), covers_wall=True),
    "dining table": Piece(dining_table, (1.6, 2.1), (1.7, 1.8), against_wall=False, symmetry="half"),
    "drawers": Piece(drawers, (0.8, 1.2), (0.42, 0.5), covers_wall=True),
    "floor lamp": Piece(floor_lamp, (0.42, 0.42), (0.42, 0.42), tall=True, covers_wall=True, symmetry="any"),
    "fridge": Piece(fridge, (0.6, 0.7), (0.62, 0.68), tall=True, covers_wall=True),
    "kitchen row": Piece(kitchen_row, (1.8, 2.7), (0.6, 0.62), tall=True, covers_wall=True),
    "plant": Piece(plant, (0.5, 0.5), (0.5, 0.5), tall=True, covers_wall=True),
    "sideboard": Piece(sideboard, (1.3, 1.8), (0.4, 0.45), covers_wall=True),
    "sofa": Piece(sofa, (1.5, 2.1), (0.8, 0.9)),
    "wardrobe": Piece(wardrobe, (1.1, 1.8), (0.55, 0.62), tall=True, covers_wall=True),
}

ROOMS = {
    "living room": ["sofa", "sideboard", "bookshelf", "armchair", "coffee table", "plant", "floor lamp", "drawers"],
    "kitchen": ["kitchen row", "fridge", "dining table", "bookshelf", "plant", "drawers"],
    "bedroom": ["bed", "wardrobe", "drawers", "plant", "armchair", "floor lamp", "bookshelf"],
    "study": ["desk", "bookshelf", "bookshelf", "sofa", "plant", "drawers", "coffee table", "floor lamp"],
    "bathroom": ["bathtub", "basin", "plant", "wardrobe", "drawers"],
}

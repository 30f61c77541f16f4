"""A street front: one facade whose windows repeat for the whole length of a street, over a road that does not repeat.

Terraces, office blocks and barracks are built so. Two captures of such a front agree in most of the facade wherever one
is laid along the other; the road, what stands on it and the curtains of some windows fix where along it.

Place frame: metres, x along the front, y towards the road, z up, the road at z = 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

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
from gsmap_synthetic.textures import Material

_GLOW = 0.85  # daylight, as in `gsmap_synthetic.court`
_STOREYS, _STOREY_M, _ROAD_M = 2, 3.0, 8.0
_SLAB_M = 6.0
FAR_M = 14.0
"""Depths beyond this are not captured: what the walk shows from afar is seen under a flat angle and too rarely."""


def make_front(
    seed: int = 0,
    *,
    length_m: float = 60.0,
    pitch_m: float = 3.3,
    curtains: float = 1 / 3,
    things_per_m: float = 0.15,
    texel_m: float = 0.03,
    progress: Callable[[float, str], None] | None = None,
) -> Place:
    """Build the street front of a seed.

    Args:
        seed: which front.
        length_m: along x.
        pitch_m: from one window to the next; the facade repeats after it.
        curtains: share of windows with curtains of their own colour.
        things_per_m: crates, tubs and posts on the road, per metre of its length.
        texel_m: how fine the baked colours are.

    Raises:
        ConfigError: a front shorter than three windows.
    """
    if not length_m >= 3 * pitch_m > 0:
        raise ConfigError(f"a front has three windows or more, got length_m={length_m}, pitch_m={pitch_m}")
    rng, s = np.random.default_rng([seed, 41]), Surfaces()
    _road(s, rng, length_m)
    _facade(s, rng, length_m, pitch_m, curtains)
    for x in rng.uniform(1, length_m - 1, round(things_per_m * length_m)):
        _thing(s.at(x, rng.uniform(1.0, 3.0), 0, rng.uniform(0, np.pi)), rng)
    return Place(seed, (), (), bake(s, texel_m=texel_m, progress=progress), s)


def _road(s: Surfaces, rng: np.random.Generator, length: float) -> None:
    """Asphalt with patches, drains and stains, no two alike."""
    ground = s.object("road", "shell")
    tone = colour(rng, (0.05, 0.15), (0.0, 0.2), (0.3, 0.5))
    asphalt = tx.marble(tone, 0.6 * tone, int(rng.integers(1 << 20)))
    for x in np.arange(0, length, _SLAB_M):
        ground.rectangle([x, 0, 0], [min(_SLAB_M, length - x), 0, 0], [0, _ROAD_M, 0], asphalt, (x, 0), _GLOW)
    for _ in range(int(0.6 * length)):
        w, d = rng.uniform(0.4, 1.8, 2)
        shade, seed = colour(rng, (0.0, 0.2), (0.0, 0.35), (0.15, 0.75)), int(rng.integers(1 << 20))
        kinds: list[Material] = [tx.plaster(shade, seed), tx.fabric(shade, 0.5 * shade, seed, 1)]
        x, y = rng.uniform(0.2, length - w - 0.2), rng.uniform(0.2, _ROAD_M - d - 0.2)
        ground.box(x + w / 2, y + d / 2, 0, w, d, 0.012, kinds[int(rng.integers(2))], glow=_GLOW)


def _facade(s: Surfaces, rng: np.random.Generator, length: float, pitch: float, curtains: float) -> None:
    """One bay after the other, each the same to the last texel but for its curtains."""
    tone = colour(rng, (0.02, 0.12), (0.15, 0.5), (0.5, 0.8))
    brick = tx.tiles(tone, 0.65 * tone, int(rng.integers(1 << 20)), 0.24, 0)
    frame, glass = tx.plain(np.full(3, 0.75), 5), tx.plain(colour(rng, (0.5, 0.65), (0.2, 0.4), (0.1, 0.25)), 3)
    sill = tx.marble(np.full(3, 0.6), np.full(3, 0.3), 4)
    wide, high, deep, base = 0.38 * pitch, 1.6, 0.25, 0.8
    for k in range(int(np.ceil(length / pitch))):
        bay = s.at(k * pitch, 0).object("bay", "shell")
        for storey in range(_STOREYS):
            z = storey * _STOREY_M
            side = (pitch - wide) / 2
            panels = [(0, z, side, _STOREY_M), (side + wide, z, side, _STOREY_M), (side, z, wide, base)]
            panels.append((side, z + base + high, wide, _STOREY_M - base - high))
            for x, low, w, h in panels:  # seen from the road x runs to the left
                bay.rectangle([x + w, 0, low], [-w, 0, 0], [0, 0, h], brick, (-x - w, low), _GLOW)
            low, right = z + base, side + wide
            bay.rectangle([right, -deep, low], [-wide, 0, 0], [0, 0, high], glass, (0, 0), _GLOW)
            bay.rectangle([side, -deep, low], [0, deep, 0], [0, 0, high], frame, (0, 0), _GLOW)
            bay.rectangle([right, 0, low], [0, -deep, 0], [0, 0, high], frame, (0, 0), _GLOW)
            bay.rectangle([side, 0, low], [0, -deep, 0], [wide, 0, 0], sill, (0, 0), _GLOW)
            bay.box(pitch / 2, 0.06, low - 0.12, wide + 0.2, 0.12, 0.1, sill, glow=_GLOW)
            bay.box(pitch / 2, 0.05 - deep, low, 0.07, 0.06, high, frame, glow=_GLOW)
            bay.box(pitch / 2, 0.05 - deep, low + 0.6 * high, wide, 0.06, 0.07, frame, glow=_GLOW)
            if rng.random() < curtains:
                cloth = colour(rng, saturation=(0.3, 0.8), value=(0.4, 0.9))
                drape = tx.fabric(cloth, 0.6 * cloth, int(rng.integers(1 << 20)), 0)
                reach = wide * rng.uniform(0.2, 0.45)
                bay.rectangle([right, 0.03 - deep, low], [-reach, 0, 0], [0, 0, high], drape, (0, 0), _GLOW)
        bay.box(pitch / 2, 0.1, _STOREYS * _STOREY_M - 0.25, pitch, 0.2, 0.25, sill, glow=_GLOW)


def _thing(s: Surfaces, rng: np.random.Generator) -> None:
    """A crate, a tub or a post."""
    s, seed = s.object("thing", "furniture"), int(rng.integers(1 << 20))
    tone = colour(rng, saturation=(0.3, 0.8), value=(0.3, 0.9))
    kind = int(rng.integers(3))
    if kind == 0:
        front = tx.picture(palette(rng, 5), seed, int(rng.integers(4)))
        (wide, deep), high = rng.uniform(0.4, 1.0, 2), rng.uniform(0.4, 1.1)
        s.box(0, 0, 0, wide, deep, high, tx.planks(tone, seed, 0.12, False), front, glow=_GLOW)
    elif kind == 1:
        s.lathe(0, 0, 0, [(0.3, 0), (0.45, 0.5), (0.4, 0.55), (0.15, 0.5)], tx.plaster(tone, seed), 12, _GLOW)
    else:
        s.lathe(0, 0, 0, [(0.1, 0), (0.1, 0.9), (0.0, 1.0)], tx.plain(tone, seed), 8, _GLOW)


def front_walk(place: Place, start_m: float, reach_m: float, count: int, seed: int = 0) -> np.ndarray:
    """(count, 4, 4) camera poses of a walk along the front, there and back, looking at it and ahead.

    Args:
        place: a front.
        start_m: where along it the walk begins.
        reach_m: how far along it the walk goes.
        count: poses.
    """
    rng = np.random.default_rng([place.seed, seed, 43])
    phase, out = float(rng.uniform(0, 2 * np.pi)), []
    for i in range(count):
        way = 2 * i / count
        x = start_m + reach_m * (way if way < 1 else 2 - way)
        y = 5.4 + (0.8 if way < 1 else -0.6) + 0.2 * np.sin(3 * way + phase)
        yaw = -np.pi / 2 + 0.7 * np.sin(7 * np.pi * way + phase)
        pitch = -0.1 + 0.25 * np.sin(11 * np.pi * way + phase)
        out.append(look_along(x, y, 1.6 + 0.1 * np.sin(5 * way), yaw, pitch))
    return np.stack(out)


def front_captures(
    place: Place,
    starts_m: Sequence[float],
    *,
    reach_m: float = 20.0,
    num_frames: int = 36,
    num_gaussians: int = 25_000,
    progress: Progress | None = None,
    **others: Any,
) -> list[DemoCapture]:
    """Capture a front along the stretches that begin at ``starts_m``, each in its own random frame, in metres.

    Args:
        others: of `gsmap_synthetic.make_captures`.
    """
    paths = [front_walk(place, start, reach_m, num_frames, k) for k, start in enumerate(starts_m)]
    return make_captures(
        place.seed,
        len(paths),
        steps=0,
        num_frames=num_frames,
        num_gaussians=num_gaussians,
        place=place,
        paths=paths,
        far=FAR_M,
        progress=progress,
        **others,
    )

"""Procedural materials: what every surface of a synthetic place looks like.

A material maps positions on a surface to linear-light albedo: ``material(u_m, v_m, size_m) -> (..., 3) in [0, 1]`` with
``u_m, v_m`` metres from the surface's corner and ``size_m`` its extent. Nothing here has state: one seed paints the
same texel on every machine, because the noise is an integer hash and not a generator.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Material = Callable[[np.ndarray, np.ndarray, tuple[float, float]], np.ndarray]


def _hash(x: np.ndarray, y: np.ndarray, seed: int) -> np.ndarray:
    """Pseudo-random float32 in [0, 1) of integer lattice points (a finaliser in the style of murmur3)."""
    h = (
        x.astype(np.int64).astype(np.uint32) * np.uint32(0x9E3779B1)
        ^ y.astype(np.int64).astype(np.uint32) * np.uint32(0x85EBCA77)
        ^ np.uint32((seed * 0x27D4EB2F) & 0xFFFFFFFF)
    )
    h = (h ^ (h >> np.uint32(15))) * np.uint32(0x2C1B3C6D)
    h = (h ^ (h >> np.uint32(12))) * np.uint32(0x297A2D39)
    return ((h ^ (h >> np.uint32(15))) >> np.uint32(8)).astype(np.float32) * np.float32(2.0**-24)


def noise(u: np.ndarray, v: np.ndarray, cell_m: float, seed: int) -> np.ndarray:
    """Smooth value noise in [0, 1) with features of about ``cell_m`` metres."""
    x, y = u / cell_m, v / cell_m
    xi, yi = np.floor(x), np.floor(y)
    fx, fy = x - xi, y - yi
    fx, fy = fx * fx * (3 - 2 * fx), fy * fy * (3 - 2 * fy)
    low = _hash(xi, yi, seed) * (1 - fx) + _hash(xi + 1, yi, seed) * fx
    high = _hash(xi, yi + 1, seed) * (1 - fx) + _hash(xi + 1, yi + 1, seed) * fx
    return low * (1 - fy) + high * fy


def _fractal(u: np.ndarray, v: np.ndarray, cell_m: float, seed: int, octaves: int = 3) -> np.ndarray:
    """Sum of octaves of `noise`, centred at 0, roughly in [-0.5, 0.5]."""
    octave = [0.5**k * (noise(u, v, cell_m / 2**k, seed + k) - 0.5) for k in range(octaves)]
    total = np.add.reduce(octave)
    return total / (2 - 0.5 ** (octaves - 1)) * 1.6


def _shade(colour: np.ndarray, factor: np.ndarray) -> np.ndarray:
    return np.clip(np.asarray(colour, np.float32) * factor[..., None], 0, 1)


def plain(colour: np.ndarray, seed: int = 0, amount: float = 0.12) -> Material:
    """Paint, ceramic or metal: one colour with slight mottling."""
    return lambda u, v, size: _shade(colour, 1 + amount * _fractal(u, v, 0.09, seed, 2))


def plaster(colour: np.ndarray, seed: int) -> Material:
    """A painted wall: broad stains, roller marks and grain."""

    def paint(u, v, size):
        broad = _fractal(u, v, 0.9, seed, 3)
        marks = _fractal(u, v * 0.4, 0.11, seed + 7, 2)
        return _shade(colour, 1 + 0.28 * broad + 0.10 * marks)

    return paint


def wallpaper(ground: np.ndarray, figure: np.ndarray, seed: int, motif: int, pitch_m: float) -> Material:
    """Printed paper: stripes, dots, diamonds or leaves over a mottled ground, slightly faded here and there."""

    def paint(u, v, size):
        s, t = u / pitch_m, v / pitch_m
        if motif == 0:
            mask = (np.abs((s % 1) - 0.5) < 0.22).astype(np.float32)
        elif motif == 1:
            s = s + 0.5 * (np.floor(t) % 2)
            mask = ((s % 1 - 0.5) ** 2 + (t % 1 - 0.5) ** 2 < 0.07).astype(np.float32)
        elif motif == 2:
            mask = (np.abs(s % 1 - 0.5) + np.abs(t % 1 - 0.5) < 0.38).astype(np.float32)
        else:
            s = s + 0.5 * (np.floor(t) % 2)
            p, q = s % 1 - 0.5, t % 1 - 0.5
            mask = (np.abs(p) < 0.32 * np.sqrt(np.clip(0.25 - q * q, 0, 1)) * (1 + 0.6 * np.sin(9 * q))).astype(
                np.float32
            )
        fade = np.clip(0.75 + 0.9 * _fractal(u, v, 1.1, seed, 2), 0, 1)
        mask = (mask * fade)[..., None]
        colour = np.asarray(ground, np.float32) * (1 - mask) + np.asarray(figure, np.float32) * mask
        return np.clip(colour * (1 + 0.22 * _fractal(u, v, 0.7, seed + 3, 3))[..., None], 0, 1)

    return paint


def _grain(u, v, seed):
    """Wood grain along u: long streaks, with rings that wander."""
    rings = np.sin((v * 55 + 5 * noise(u * 0.25, v, 0.10, seed)) * 2.2)
    return 0.5 * _fractal(u * 0.08, v, 0.016, seed + 1, 2) + 0.10 * rings


def wood(colour: np.ndarray, seed: int, along_v: bool = False) -> Material:
    """A piece of timber."""

    def paint(u, v, size):
        if along_v:
            u, v = v, u
        return _shade(colour, 1 + 0.55 * _grain(u, v, seed) + 0.2 * _fractal(u, v, 0.4, seed + 5, 2))

    return paint


def planks(colour: np.ndarray, seed: int, width_m: float, along_v: bool) -> Material:
    """A timber floor: staggered boards, each with its own tone and grain."""

    def paint(u, v, size):
        if along_v:
            u, v = v, u
        row = np.floor(v / width_m)
        shifted = u + 3.0 * _hash(row, row * 0, seed)
        column = np.floor(shifted / 1.15)
        tone = _hash(row, column, seed + 1) - 0.5
        warm = _hash(row, column, seed + 2) - 0.5
        joint = (v % width_m < 0.006) | (shifted % 1.15 < 0.006)
        shade = 1 + 0.7 * tone + 0.5 * _grain(shifted + 13 * tone, v, seed + 3) + 0.2 * _fractal(u, v, 0.8, seed + 4, 2)
        out = _shade(colour, np.where(joint, 0.4, shade)) * (1 + warm[..., None] * np.float32([0.12, 0.0, -0.2]))
        return np.clip(out, 0, 1)

    return paint


def tiles(colour: np.ndarray, accent: np.ndarray, seed: int, pitch_m: float, style: int) -> Material:
    """Tiles with grout: plain, checkered, or with scattered patterned tiles."""

    def paint(u, v, size):
        x, y = np.floor(u / pitch_m), np.floor(v / pitch_m)
        p, q = u / pitch_m - x - 0.5, v / pitch_m - y - 0.5
        pick = _hash(x, y, seed)
        if style == 0:
            which = pick < 0.12
        elif style == 1:
            which = (x + y) % 2 == 0
        else:
            radius = np.hypot(p, q)
            which = (pick < 0.4) & (np.abs(radius - 0.3) < 0.1) | (pick > 0.85) & (np.abs(p) + np.abs(q) < 0.35)
        base = np.where(which[..., None], np.asarray(accent, np.float32), np.asarray(colour, np.float32))
        grout = np.maximum(np.abs(p), np.abs(q)) > 0.5 - 0.005 / pitch_m
        shade = 1 + 0.35 * (_hash(x, y, seed + 1) - 0.5) + 0.25 * _fractal(u, v, 0.25, seed + 2, 3)
        return np.clip(np.where(grout[..., None], 0.32, base * shade[..., None]), 0, 1)

    return paint


def marble(colour: np.ndarray, vein: np.ndarray, seed: int) -> Material:
    """Stone with wandering veins."""

    def paint(u, v, size):
        t = np.abs(_fractal(u, v, 0.45, seed, 4)) * 7
        mask = np.exp(-t * t)[..., None]
        return np.clip(np.asarray(colour, np.float32) * (1 - mask) + np.asarray(vein, np.float32) * mask, 0, 1)

    return paint


def fabric(colour: np.ndarray, accent: np.ndarray, seed: int, style: int, pitch_m: float = 0.18) -> Material:
    """Cloth: plain weave, stripes, tartan, or patchwork."""

    def paint(u, v, size):
        s, t = u / pitch_m, v / pitch_m
        if style == 1:
            mask = ((s % 1) < 0.35).astype(np.float32)
        elif style == 2:
            mask = 0.5 * ((s % 1) < 0.3) + 0.5 * ((t % 1) < 0.3)
        elif style == 3:
            mask = _hash(np.floor(s), np.floor(t), seed)
        else:
            mask = np.zeros_like(s)
        mask = mask[..., None].astype(np.float32)
        base = np.asarray(colour, np.float32) * (1 - mask) + np.asarray(accent, np.float32) * mask
        weave = 1 + 0.16 * _fractal(u, v, 0.03, seed + 1, 2) + 0.3 * _fractal(u, v, 0.35, seed + 2, 2)
        return np.clip(base * weave[..., None], 0, 1)

    return paint


def rug(palette: np.ndarray, seed: int) -> Material:
    """A woven rug: border bands around a field of medallions."""
    palette = np.asarray(palette, np.float32)

    def paint(u, v, size):
        edge = np.minimum(np.minimum(u, size[0] - u), np.minimum(v, size[1] - v))
        s, t = u - size[0] / 2, v - size[1] / 2
        k = 2 + seed % 3
        ring = np.hypot(s, t * (1.2 + 0.1 * (seed % 5))) + 0.06 * np.cos(2 * k * np.arctan2(t, s))
        index = (np.floor(ring / 0.14) % len(palette)).astype(int)
        index = np.where(edge < 0.26, 1 + (np.floor((u + v) / 0.09) % 2).astype(int), index)
        index = np.where((edge < 0.17) | (edge > 0.24) & (edge < 0.27), 0, index)
        index = np.where(edge < 0.05, len(palette) - 1, index)
        worn = 1 + 0.25 * _fractal(u, v, 0.5, seed, 2) + 0.25 * (noise(u, v, 0.012, seed + 1) - 0.5)
        return np.clip(palette[index] * worn[..., None], 0, 1)

    return paint


def picture(palette: np.ndarray, seed: int, style: int) -> Material:
    """A framed print: a landscape, overlapping shapes, a grid, or a portrait-like figure."""
    palette = np.asarray(palette, np.float32)
    rng = np.random.default_rng(seed)
    shapes = [
        (rng.uniform(0, 1), rng.uniform(0, 1), rng.uniform(0.08, 0.35), rng.integers(len(palette))) for _ in range(9)
    ]
    round_ones = rng.random(9) < 0.5

    def paint(u, v, size):
        s, t = u / size[0], v / size[1]
        if style == 0:
            out = palette[0] * (1 - t[..., None]) + palette[1] * t[..., None]
            out[np.hypot(s - shapes[0][0], (t - 0.8) * size[1] / size[0]) < 0.09] = palette[-1]
            for k in range(3):
                ridge = 0.62 - 0.2 * k + 0.35 * (noise(s + k, s * 0, 0.23, seed + k) - 0.5)
                out[t < ridge] = palette[2 + k % (len(palette) - 2)] * (1 - 0.2 * k)
        elif style == 1:
            out = np.broadcast_to(palette[0], (*s.shape, 3)).copy()
            for (x, y, r, c), is_round in zip(shapes, round_ones, strict=True):
                inside = np.hypot(s - x, t - y) < r if is_round else (abs(s - x) < r) & (abs(t - y) < r * 0.6)
                out[inside] = palette[c]
        elif style == 2:
            n = 3 + seed % 4
            out = palette[(_hash(np.floor(s * n), np.floor(t * (n + 1)), seed) * len(palette)).astype(int)]
        else:
            out = palette[0] * (0.7 + 0.3 * t[..., None])
            out[(np.abs(s - 0.5) < 0.36) & (t < 0.32 - 0.5 * (s - 0.5) ** 2)] = palette[1]
            out[((s - 0.5) / 0.17) ** 2 + ((t - 0.55) / 0.24) ** 2 < 1] = palette[2]
            out[((s - 0.5) / 0.2) ** 2 + ((t - 0.72) / 0.14) ** 2 < 1] = palette[-1] * 0.5
        mat = np.minimum(np.minimum(u, size[0] - u), np.minimum(v, size[1] - v)) < 0.06 * min(size)
        out = np.where(mat[..., None], np.float32(0.85), out)
        return np.clip(out * (1 + 0.25 * _fractal(u, v, 0.05, seed + 11, 2))[..., None], 0, 1).astype(np.float32)

    return paint


def book(colour: np.ndarray, ink: np.ndarray, seed: int) -> Material:
    """A book's spine: bands, a title and wear."""

    def paint(u, v, size):
        t = v / size[1]
        title = (np.abs(t - 0.62) < 0.16) & (np.abs(u / size[0] - 0.5) < 0.22) & (noise(u, v, 0.012, seed) > 0.35)
        bands = (np.abs(t - 0.12) < 0.025) | (np.abs(t - 0.88) < 0.025) & (seed % 2 == 0)
        base = np.where((title | bands)[..., None], np.asarray(ink, np.float32), np.asarray(colour, np.float32))
        return np.clip(base * (1 + 0.2 * _fractal(u, v, 0.04, seed, 2))[..., None], 0, 1)

    return paint


def outdoors(seed: int) -> Material:
    """What a window shows: sky with clouds over hills and trees."""

    def paint(u, v, size):
        t = v / size[1]
        cloud = np.clip(1.8 * _fractal(u, v * 2, 0.5, seed, 3), 0, 1)[..., None]
        sky = np.float32([0.45, 0.65, 0.95]) * (1.25 - 0.35 * t[..., None]) * (1 - cloud) + cloud
        hill = 0.30 + 0.22 * (noise(u, u * 0, 0.6, seed + 4) - 0.3)
        tree = 0.2 + 0.35 * (noise(u, u * 0, 0.17, seed + 5) - 0.2)
        green = np.float32([0.16, 0.28, 0.08]) * (1 + 0.9 * _fractal(u, v, 0.06, seed + 6, 2))[..., None]
        out = np.where((t < hill)[..., None], np.float32([0.35, 0.45, 0.30]), sky)
        return np.clip(np.where((t < tree)[..., None], green, out), 0, 1)

    return paint


def leaf(colour: np.ndarray, seed: int) -> Material:
    """A leaf with a midrib."""

    def paint(u, v, size):
        rib = np.abs(u / size[0] - 0.5) < 0.06
        return _shade(colour, np.where(rib, 1.5, 1 + 0.5 * _fractal(u, v, 0.05, seed, 2)))

    return paint


def repainted(material: Material, colour: np.ndarray, mean: float) -> Material:
    """Another colour on the same thing: the pattern of ``material``, whose mean luminance is ``mean``, stays."""

    def paint(u, v, size):
        luminance = material(u, v, size) @ np.float32([0.2126, 0.7152, 0.0722])
        return _shade(colour, np.clip(luminance / np.float32(max(mean, 0.02)), 0.35, 1.8))

    return paint

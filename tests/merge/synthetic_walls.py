"""Small synthetic scenes: a textured wall seen by captures that each know a stretch of it."""

import numpy as np

from gsmap.merge import PosedScene
from gsmap.types import Cameras, Gaussians


def texture(x, y):
    """(N, 3) colours in [0.1, 0.9] with detail at several scales."""
    waves = [np.sin(7 * x + 1) * np.cos(5 * y), np.sin(3 * x - 2 * y), np.cos(11 * y + 2 * x)]
    return 0.5 + 0.4 * np.stack(waves, axis=-1)


def wall(seed, low, high, spacing=0.04, z=0.0, colour=texture, half_height=0.6, grain=0.0):
    """Flat Gaussians on the plane z, jittered, with the wall's texture."""
    rng = np.random.default_rng(seed)
    xs, ys = np.arange(low, high, spacing), np.arange(-half_height, half_height, spacing)
    x, y = (v.ravel() + rng.uniform(-0.4, 0.4, v.size) * spacing for v in np.meshgrid(xs, ys))
    n = len(x)
    sh = np.zeros((n, 4, 3))
    # Every training leaves its own grain.
    sh[:, 0] = (colour(x, y) + rng.normal(0, grain, (n, 3)) - 0.5) / 0.28209479177387814
    scale = np.log(np.tile([0.8 * spacing, 0.8 * spacing, 0.1 * spacing], (n, 1)))
    means = np.stack([x, y, z + rng.normal(0, 0.2 * spacing, n)], axis=1)
    return Gaussians(means, np.tile([1.0, 0, 0, 0], (n, 1)), scale, np.full(n, 4.0), sh)


def cameras_facing(xs, distance=1.2, width=64, height=48):
    """Cameras in front of the wall, at z < 0, looking along +z."""
    T = np.tile(np.eye(4), (len(xs), 1, 1))
    T[:, 0, 3], T[:, 2, 3] = xs, -distance
    k = np.tile([60.0, 60, width / 2, height / 2], (len(xs), 1))
    return Cameras(T, k, np.tile([width, height], (len(xs), 1)))


def two_scenes(grain=0.15):
    """Captures a and b, who share the middle of the wall; b stands 1 cm off."""
    a = PosedScene(wall(0, -1.5, 0.5, grain=grain), cameras_facing(np.linspace(-1.1, 0.1, 7)), "a")
    b = PosedScene(wall(1, -0.5, 1.5, z=0.01, grain=grain), cameras_facing(np.linspace(-0.1, 1.1, 7)), "b")
    return [a, b]

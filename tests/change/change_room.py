"""A corner of a room with boxes in it, as two captures that know the truth."""

import numpy as np

from gsmap.types import Cameras, Gaussians, PosedScene, Sim3

SPACING_M = 0.05
_SH = 0.28209479177387814


def stripes(seed):
    """A texture: (N, 2) places in metres to (N, 3) colours, of its own for each seed."""
    rng = np.random.default_rng(seed)
    base, other = rng.uniform(0.15, 0.85, (2, 3))
    way = rng.uniform(2, 5, 2)

    def colour(uv):
        share = 0.5 + 0.5 * np.sin(uv @ way + 1)
        return base + (0.5 * share)[:, None] * (other - base)

    return colour


def plain(*rgb):
    return lambda uv: np.tile(rgb, (len(uv), 1))


def sheet(corner, u, v, colour, rng):
    """Flat Gaussians on a rectangle, jittered; places, normals and colours."""
    corner, u, v = (np.asarray(a, float) for a in (corner, u, v))
    long, high = np.linalg.norm(u), np.linalg.norm(v)
    s, t = np.meshgrid(np.arange(SPACING_M / 2, long, SPACING_M), np.arange(SPACING_M / 2, high, SPACING_M))
    uv = np.stack([s.ravel(), t.ravel()], 1) + rng.uniform(-0.3, 0.3, (s.size, 2)) * SPACING_M
    points = corner + uv[:, :1] * u / long + uv[:, 1:] * v / high
    normal = np.cross(u, v) / (long * high)
    return points + rng.normal(0, 0.002, (len(uv), 1)) * normal, np.tile(normal, (len(uv), 1)), colour(uv)


def box(x, y, width, depth, height, seed, yaw=0.0, paint=None):
    """A box that stands on the floor, its middle at (x, y); every side has a texture of its own."""
    w, d, h = width / 2, depth / 2, height
    sides = [
        ([-w, -d, 0], [2 * w, 0, 0], [0, 0, h]),
        ([w, -d, 0], [0, 2 * d, 0], [0, 0, h]),
        ([w, d, 0], [-2 * w, 0, 0], [0, 0, h]),
        ([-w, d, 0], [0, -2 * d, 0], [0, 0, h]),
        ([-w, -d, h], [2 * w, 0, 0], [0, 2 * d, 0]),
    ]
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    out = []
    for k, (corner, u, v) in enumerate(sides):
        colour = paint or stripes(100 * seed + k)
        out.append((turn @ corner + [x, y, 0], turn @ u, turn @ v, colour))
    return out


def shell(wall=None):
    """Floor and two walls of a room of 3 by 3 metres, 2.2 high."""
    return [
        ([0, 0, 0], [3, 0, 0], [0, 3, 0], stripes(1)),
        ([0, 3, 0], [3, 0, 0], [0, 0, 2.2], wall or stripes(2)),
        ([0, 0, 0], [0, 3, 0], [0, 0, 2.2], stripes(3)),
    ]


def gaussians(rectangles, seed, gain=1.0):
    rng = np.random.default_rng(seed)
    points, normals, colours = (
        np.concatenate(parts) for parts in zip(*(sheet(*r, rng) for r in rectangles), strict=True)
    )
    n = len(points)
    colours = np.clip(colours * gain + rng.normal(0, 0.01, (n, 3)), 0, 1)
    helper = np.where(np.abs(normals[:, :1]) < 0.8, [1.0, 0, 0], [0, 1.0, 0])
    x = np.cross(helper, normals)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    frames = np.stack([x, np.cross(normals, x), normals], axis=2)
    from gsmap.geometry.rotations import matrices_to_quats

    scales = np.log(np.tile([0.75 * SPACING_M, 0.75 * SPACING_M, 0.1 * SPACING_M], (n, 1)))
    sh = ((colours - 0.5) / _SH)[:, None, :]
    return Gaussians(points, matrices_to_quats(frames), scales, np.full(n, 4.0), sh)


def cameras(seed, count=12, toward=(1.3, 1.5, 0.4), angles=(-1.9, 0.35)):
    """Cameras on an arc about the middle of the room, on the side without walls, all looking at it."""
    rng = np.random.default_rng([seed, 4])
    T = np.tile(np.eye(4), (count, 1, 1))
    for k, angle in enumerate(np.linspace(*angles, count) + rng.uniform(-0.05, 0.05, count)):
        eye = np.array([1.4 + 1.9 * np.cos(angle), 1.6 + 1.9 * np.sin(angle), 1.3 + 0.4 * (k % 3)])
        forward = np.asarray(toward) + rng.uniform(-0.2, 0.2, 3) - eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        T[k, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        T[k, :3, 3] = eye
    focal = np.tile([88.0, 88, 64, 48], (count, 1))
    return Cameras(T, focal, np.tile([128, 96], (count, 1)))


def capture(rectangles, seed, gain=1.0, **views):
    """One capture of a room: its own grain and its own path."""
    return PosedScene(gaussians(rectangles, seed, gain), cameras(seed, **views), f"c{seed}")


def moved_by(yaw, middle, to):
    """The move of a box by a yaw about its middle (x, y), to another middle."""
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    return Sim3(turn, np.array([*to, 0.0]) - turn @ np.array([*middle, 0.0]))

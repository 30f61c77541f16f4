"""Cameras for a scene that came without: placed in its free space, looking around."""

from __future__ import annotations

import numpy as np

from gsmap.types import Cameras, Gaussians

_POINTS = 20_000
_CANDIDATES = 192
_GRID = 32
_PANORAMA = (16, 32)  # bins of latitude and longitude
_ENCLOSED = 0.6  # share of directions that hit something: a room without a ceiling has more, the outside less
_SIDE_PX = 512


def synthesise_cameras(gaussians: Gaussians, *, num_positions: int = 16, seed: int = 0) -> Cameras:
    """Cameras that together see the surfaces of a scene.

    Indoors (somewhere most directions hit a surface): up to ``num_positions`` places in free space, each the one that
    sees most of what those before did not, looking along all six axes with 90 degrees. Else: a sphere around the
    whole, looking at its middle. Same input, same cameras.

    Returns:
        Cameras in the scene's frame with ``synthesised=True``.
    """
    rng = np.random.default_rng(seed)
    points = _solid_points(gaussians, rng)
    low, high = np.percentile(points, [1, 99], axis=0)
    diagonal = float(np.linalg.norm(high - low)) or 1.0
    candidates = _free_positions(points, low, high, diagonal, rng)
    panoramas = [_panorama(points, position) for position in candidates]
    inside = [i for i, (share, _) in enumerate(panoramas) if share >= _ENCLOSED]
    poses = _look_around(points, candidates, panoramas, inside, num_positions) if len(inside) >= 4 else []
    if not poses:
        poses, focal_px = _orbit(low, high, diagonal), _SIDE_PX / (2 * np.tan(np.radians(30)))
    else:
        focal_px = _SIDE_PX / 2  # 90 degrees
    n = len(poses)
    intrinsics = np.tile([focal_px, focal_px, _SIDE_PX / 2, _SIDE_PX / 2], (n, 1))
    sizes = np.full((n, 2), _SIDE_PX)
    return Cameras(np.array(poses), intrinsics, sizes, tuple(f"synthesised_{i:03d}" for i in range(n)), True)


def _solid_points(gaussians: Gaussians, rng: np.random.Generator) -> np.ndarray:
    """(N, 3) centres of a sample of the opaque Gaussians that are not huge; of all where none is."""
    widest = gaussians.log_scales.max(1)
    solid = np.flatnonzero((gaussians.logit_opacities > -0.85) & (widest <= np.percentile(widest, 98)))
    if not len(solid):
        solid = np.arange(len(gaussians))
    if len(solid) > _POINTS:
        solid = np.sort(rng.choice(solid, _POINTS, replace=False))
    return gaussians.means[solid].astype(np.float64)


def _free_positions(
    points: np.ndarray, low: np.ndarray, high: np.ndarray, diagonal: float, rng: np.random.Generator
) -> np.ndarray:
    """(M, 3) positions inside the box, away from every point, spread by farthest-point sampling."""
    from scipy.spatial import cKDTree

    cells = np.stack(np.meshgrid(*[np.linspace(0, 1, _GRID)] * 3, indexing="ij"), -1).reshape(-1, 3)
    cells = low + (cells + rng.uniform(-0.5, 0.5, cells.shape) / _GRID).clip(0, 1) * (high - low)
    clearance = cKDTree(points).query(cells, distance_upper_bound=0.2 * diagonal)[0].clip(max=0.2 * diagonal)
    free = cells[clearance >= 0.03 * diagonal]
    if len(free) < 8:
        free = cells[np.argsort(-clearance)[:64]]
    chosen = [0]
    distance = np.linalg.norm(free - free[0], axis=1)
    while len(chosen) < min(_CANDIDATES, len(free)):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(free - free[chosen[-1]], axis=1))
    return free[chosen]


def _panorama(points: np.ndarray, position: np.ndarray) -> tuple[float, np.ndarray]:
    """Share of all directions (by solid angle) in which something lies, and the indices of the points seen."""
    rows, columns = _PANORAMA
    offset = points - position
    distance = np.linalg.norm(offset, axis=1)
    # Equal steps of the sine of the latitude are equal solid angles.
    sine = (offset[:, 2] / np.maximum(distance, 1e-12) + 1) / 2
    angle = np.arctan2(offset[:, 1], offset[:, 0]) / (2 * np.pi) + 0.5
    row = np.minimum((sine * rows).astype(int), rows - 1)
    column = np.minimum((angle * columns).astype(int), columns - 1)
    nearest = np.full(rows * columns, np.inf)
    bins = row * columns + column
    np.minimum.at(nearest, bins, distance)
    visible = np.flatnonzero(distance <= 1.1 * nearest[bins])
    return float(np.isfinite(nearest).mean()), visible


def _look_around(
    points: np.ndarray,
    candidates: np.ndarray,
    panoramas: list[tuple[float, np.ndarray]],
    inside: list[int],
    num_positions: int,
) -> list[np.ndarray]:
    """Views along the axes from the positions that, chosen greedily, see the most; views of nothing are left out."""
    unseen = np.ones(len(points), bool)
    poses = []
    for _ in range(num_positions):
        gain = [int(unseen[panoramas[i][1]].sum()) for i in inside]
        best = inside[int(np.argmax(gain))]
        if max(gain) < 0.002 * len(points):
            break
        visible = panoramas[best][1]
        unseen[visible] = False
        offset = points[visible] - candidates[best]
        ahead = np.abs(offset).max(1)
        for axis in range(3):
            for sign in (1, -1):
                if (sign * offset[:, axis] >= ahead).sum() >= 0.02 * len(visible):
                    direction = np.zeros(3)
                    direction[axis] = sign
                    poses.append(_look(candidates[best], candidates[best] + direction))
    return poses


def _orbit(low: np.ndarray, high: np.ndarray, diagonal: float) -> list[np.ndarray]:
    """Views from a sphere that holds the whole box: Fibonacci points, 60 degrees of view."""
    center, count = (low + high) / 2, 48
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    angle = k * np.pi * (1 + 5**0.5)
    ring = np.sqrt(1 - z**2)
    sphere = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], 1)
    return [_look(center + 1.1 * diagonal * p, center) for p in sphere]


def _look(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    """(4, 4) camera-to-frame pose with OpenCV axes, looking at ``target``; image down is one of the frame's axes."""
    forward = (target - position) / np.linalg.norm(target - position)
    down = np.zeros(3)
    down[1 if abs(forward[1]) < 0.9 else 2] = 1.0
    right = np.cross(down, forward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    pose[:3, 3] = position
    return pose

"""Which way is up."""

from __future__ import annotations

import numpy as np

from gsmap.describe.cloud import downsample, local_planes
from gsmap.types import Cameras

_KERNEL_DEG = 4.0  # how far a floor's or wall's normals scatter
_MAX_NORMALS = 6000


def estimate_up(points: np.ndarray, cameras: Cameras | None) -> np.ndarray | None:
    """Unit vector against gravity (3,) in the points' frame, or None where it cannot be told.

    Cameras are held upright: the mean up of the images is right to some 35 degrees (they may all look down), and where
    the images turn about the vertical, the axis most nearly perpendicular to all image rows is right to a few degrees.
    Within that cone the direction is taken that most surface normals are parallel to (floors, tables, ceilings) or
    perpendicular to (walls). Without cameras, or with cameras that gsmap made up, see `_up_of_room`.

    Args:
        points: (N, 3) surface points, any unit.
    """
    up, cone_deg = _up_of_cameras(cameras)
    if len(points) < 200:
        return up
    normals, weights, sample = _planes(points)
    if weights.sum() <= 0:
        return up
    directions = _sphere(8000)
    if up is None:
        return _up_of_room(sample, normals, weights, directions[directions[:, 2] >= 0])
    near = directions[directions @ up > np.cos(np.radians(cone_deg))]
    return _refine(near[np.argmax(_uprightness(near, normals, weights))], normals, weights)


def rotation_to_z(up: np.ndarray) -> np.ndarray:
    """A rotation (3, 3) that takes ``up`` to +z; the turn about z is arbitrary but depends on ``up`` alone."""
    z = np.asarray(up, float) / np.linalg.norm(up)
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def _up_of_cameras(cameras: Cameras | None) -> tuple[np.ndarray | None, float]:
    """Rough up and the cone in degrees it is good to."""
    if cameras is None or cameras.synthesised or len(cameras) == 0:
        return None, 180.0
    rotation = cameras.T_frame_camera[:, :3, :3]
    rows, mean_up = rotation[:, :, 0], -rotation[:, :, 1].mean(0)
    if np.linalg.norm(mean_up) < 0.3:  # cameras at all angles, as around an object
        return None, 180.0
    mean_up /= np.linalg.norm(mean_up)
    values, vectors = np.linalg.eigh(rows.T @ rows / len(rows))
    axis = vectors[:, 0] * (np.sign(vectors[:, 0] @ mean_up) or 1.0)
    if values[1] > 0.1 and values[0] < 0.25 * values[1] and axis @ mean_up > 0.7:
        return axis, 15.0
    return mean_up, 45.0


def _planes(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normals and weights of a sample of the surface, and the sample."""
    span = np.ptp(np.percentile(points, [2, 98], axis=0), axis=0)
    cell = float(np.sort(span)[1:].mean()) / 60 or 1.0
    sample, _ = downsample(points, points[:, :0], cell)
    normals, planarity = local_planes(sample, 40)
    step = max(1, len(sample) // _MAX_NORMALS)
    return normals[::step], planarity[::step] ** 2, sample


def _sphere(count: int) -> np.ndarray:
    """Evenly spread unit vectors (Fibonacci lattice)."""
    i = np.arange(count) + 0.5
    z, turn = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], 1)


def _uprightness(directions: np.ndarray, normals: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Weight of the normals along each direction plus half of that of those across it, (D,)."""
    squared = (directions.astype(np.float32) @ normals.T.astype(np.float32)) ** 2
    sharp = np.float32(0.5 / np.radians(_KERNEL_DEG) ** 2)  # the sine of an angle stands for the angle
    score = np.exp(-sharp * (1 - squared)) + 0.5 * np.exp(-sharp * squared)
    return score @ (weights / weights.sum()).astype(np.float32)


def _refine(up: np.ndarray, normals: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The direction that fits the horizontal and vertical planes near ``up`` best, in the least-squares sense."""
    for kernel_deg in (4.0, 3.0, 2.0, 1.5, 1.5):
        angle = np.degrees(np.arccos(np.minimum(np.abs(normals @ up), 1)))
        along = weights * np.exp(-0.5 * (angle / kernel_deg) ** 2)
        across = weights * np.exp(-0.5 * ((90 - angle) / kernel_deg) ** 2)
        axis = np.linalg.eigh((normals * (0.5 * across - along)[:, None]).T @ normals)[1][:, 0]
        up = axis * (np.sign(axis @ up) or 1.0)
    return up


def _up_of_room(
    points: np.ndarray, normals: np.ndarray, weights: np.ndarray, directions: np.ndarray
) -> np.ndarray | None:
    """The vertical of a room that came without cameras, or None.

    Candidates are the axes of the strongest heaps of normals. A vertical has what no horizontal axis has: nearly every
    cell of the plan seen along it lies over a floor or under a ceiling, and the plan is large. Its sign: between floor
    and ceiling there is more surface in the lower half. None when floor and ceiling together cover less than 0.7 of the
    plan (a part of a room), the best axis does not beat the next by a fifth, or the halves balance.
    """
    score = _uprightness(directions, normals, weights)
    axes: list[np.ndarray] = []
    for i in np.argsort(-score):
        if all(abs(directions[i] @ a) < np.cos(np.radians(20)) for a in axes):
            axes.append(directions[i])
        if len(axes) == 6:
            break
    axes = [_refine(a, normals, weights) for a in axes]
    covers, shares = np.array([_plan_cover(points, a) for a in axes]).T
    best = int(np.argmax(covers))
    if shares[best] < 0.7:
        return None
    others = [c for a, c in zip(axes, covers, strict=True) if abs(a @ axes[best]) < np.cos(np.radians(10))]
    if others and covers[best] < 1.2 * max(others):
        return None
    height = points @ axes[best]
    low, high = np.percentile(height, [2, 98])
    t = (height - low) / max(high - low, 1e-12)
    below, above = np.sum((t > 0.1) & (t < 0.5)), np.sum((t > 0.5) & (t < 0.9))
    if max(below, above) < 1.15 * min(below, above):
        return None
    return axes[best] if below > above else -axes[best]


def _plan_cover(points: np.ndarray, axis: np.ndarray) -> tuple[float, float]:
    """How much of the plan seen along ``axis`` has surface on the lowest and on the highest plane.

    Returns:
        The mean area of the two, and the sum of both as shares of the plan.
    """
    local = points @ rotation_to_z(axis).T
    low, high = np.percentile(local[:, 2], [2, 98])
    cell = float(np.ptp(points, axis=0).max()) / 60 or 1.0
    slab = 0.04 * (high - low)
    plan = _num_cells(local, cell)
    covered = sum(_num_cells(local[np.abs(local[:, 2] - plane) < slab], cell) for plane in (low, high))
    return 0.5 * covered * cell**2, covered / plan


def _num_cells(points: np.ndarray, cell: float) -> int:
    key = np.floor(points[:, :2] / cell).astype(np.int64)
    return len(np.unique(key[:, 0] * 2**32 + key[:, 1]))

"""Compute axis-aligned boxes (2, 3): the lowest and the highest corner."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gsmap.types import Sim3

_MAX_SAMPLE = 4_000  # number of points that suffices for the size of a place


def box_corners(bounds: np.ndarray) -> np.ndarray:
    """Return the (8, 3) corners of a box; bit 0, 1 or 2 of a corner's index is set if its x, y or z is that of the high
    end."""
    return np.array([[bounds[i >> axis & 1][axis] for axis in range(3)] for i in range(8)], dtype=np.float64)


def box_around(points: np.ndarray) -> np.ndarray:
    """Return the smallest box (2, 3) around points (N, 3), N > 0."""
    columns = points.T  # twenty times as fast as min(0) and max(0) over rows of three
    return np.array([[column.min() for column in columns], [column.max() for column in columns]])


def are_finite(points: np.ndarray) -> np.ndarray:
    """Return an (N,) mask of points (N, 3) without NaN and infinity."""
    x, y, z = (np.isfinite(column) for column in points.T)
    result: np.ndarray = x & y & z
    return result


def inside(points: np.ndarray, bounds: np.ndarray | None, margin: float = 0.0) -> np.ndarray:
    """Return an (N,) mask of points (N, 3) in bounds (2, 3) enlarged by a margin (``low <= x < high``); with None all
    are inside."""
    if bounds is None:
        return np.ones(len(points), dtype=bool)
    low, high = bounds[0] - margin, bounds[1] + margin
    x, y, z = ((points[:, k] >= low[k]) & (points[:, k] < high[k]) for k in range(3))  # `all` along rows is far slower
    result: np.ndarray = x & y & z
    return result


def moved_box(bounds: np.ndarray, S_a_b: Sim3) -> np.ndarray:
    """Return the box (2, 3) in frame a around a box in frame b."""
    return box_around(S_a_b.apply(box_corners(bounds)))


def box_overlaps(a: np.ndarray, b: np.ndarray, pad: np.ndarray | float = 0.0) -> np.ndarray:
    """Return the intersection over union (N, M) of boxes (N, 2, 3) and (M, 2, 3).

    Args:
        pad: enlarge the boxes of each pair by this on every side; a number, or (N, M, 1).
    """
    a, b = a[:, None], b[None]
    low, high = np.maximum(a[:, :, 0], b[:, :, 0]) - pad, np.minimum(a[:, :, 1], b[:, :, 1]) + pad
    both = np.clip(high - low, 0, None).prod(2)
    volumes = [(box[:, :, 1] - box[:, :, 0] + 2 * pad).prod(2) for box in (a, b)]
    found: np.ndarray = both / (volumes[0] + volumes[1] - both)
    return found


def robust_box(points: np.ndarray, weights: np.ndarray | None = None, outside: float = 0.01) -> np.ndarray:
    """Return the box (2, 3) between two quantiles of points (N, 3), N > 0, along each axis, which is robust to
    outliers.

    Args:
        weights: (N,) weights of the points; equal by default.
        outside: share of the weight beyond each side of the box.
    """
    weights = np.ones(len(points)) if weights is None else weights
    out = np.empty((2, 3))
    for axis in range(3):
        order = np.argsort(points[:, axis], kind="stable")
        share = np.cumsum(weights[order])
        at = np.searchsorted(share, [outside * share[-1], (1 - outside) * share[-1]])
        out[:, axis] = points[order[np.minimum(at, len(order) - 1)], axis]
    return out


def upright_box(points: np.ndarray, up: np.ndarray, outside: float = 0.01) -> tuple[np.ndarray, np.ndarray]:
    """Return the upright box with the smallest floor area around points (N, 3), N > 0: the rotation (3, 3) whose rows
    are its length, its width and ``up``, and the bounds (2, 3) along these.

    Args:
        up: (3,) unit vector.
        outside: share of the points beyond each side.
    """
    points = points[np.linspace(0, len(points) - 1, min(len(points), _MAX_SAMPLE)).astype(int)]
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    first /= np.linalg.norm(first)
    second = np.cross(up, first)
    turns = np.radians(np.arange(180))
    along = np.cos(turns)[:, None] * first + np.sin(turns)[:, None] * second
    low, high = np.quantile(points @ along.T, [outside, 1 - outside], axis=0)
    length, width = high - low, np.roll(high - low, 90)
    best = int(np.where(length >= width, length * width, np.inf).argmin())
    axes = np.stack([along[best], np.cross(up, along[best]), up])
    bounds: np.ndarray = np.quantile(points @ axes.T, [outside, 1 - outside], axis=0)
    return axes, bounds


def cube_around(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the centre (3,) and the edge length of the smallest cube around points (N, 3), N > 0."""
    low, high = box_around(points).astype(np.float64)
    return (low + high) / 2, float(max((high - low).max(), 1e-6))


def octants(points: np.ndarray, center: np.ndarray, side: float) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Yield the octants of a cube that contain any of the points (N, 3): number, mask (N,) and centre (3,)."""
    octant = ((points >= center) @ [1, 2, 4]).astype(int)
    for i in np.unique(octant).tolist():
        yield i, octant == i, center + side / 4 * np.where([i & 1, i & 2, i & 4], 1, -1)

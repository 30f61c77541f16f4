"""Which way is up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.describe.cloud import downsample, local_planes
from gsmap.describe.heading import Held, turned_about
from gsmap.geometry.directions import fibonacci_sphere, level_frame
from gsmap.types import Cameras


@dataclass(frozen=True)
class Params:
    """How the vertical is found.

    Args:
        kernel_deg: how far the normals of a floor or wall scatter.
        max_normals: the surface is thinned to about this many.
        min_plan_cover: without cameras, the least share of the plan that floor and ceiling cover together.
        min_lead: without cameras, how many times more than the next axis the vertical must cover.
        min_imbalance: without cameras, how many times more surface the lower half must have than the upper.
    """

    kernel_deg: float = 4.0
    max_normals: int = 6000
    min_plan_cover: float = 0.7
    min_lead: float = 1.2
    min_imbalance: float = 1.15


_COMMON_DEG = 15.0  # directions nearer than this may be one


def estimate_up(points: np.ndarray, cameras: Cameras | None, params: Params | None = None) -> np.ndarray | None:
    """Unit vector against gravity (3,) in the points' frame, or None where it cannot be told.

    Cameras that turn about the vertical tell it by themselves, whatever their pitch (see
    `gsmap.describe.heading.turned_about`); within a cone around what they say the direction is taken that most surface
    normals are parallel to (floors, tables, ceilings) or perpendicular to (walls). Cameras on one heading leave the
    pitch open: what is a wall to one that looks ahead is the ground to one that looks down. There a second witness must
    name the same axis of the scene: the cameras' way, a small turn, or the room (`_up_of_room`). Without cameras, or
    with cameras that gsmap made up, the room alone decides.

    Args:
        points: (N, 3) surface points, any unit.
        cameras: in the points' frame.
    """
    params = params or Params()
    held = None if cameras is None or cameras.synthesised or not len(cameras) else Held.of(cameras)
    turned = None if held is None else turned_about(held)
    if len(points) < 200:
        return turned.up if turned and turned.sure else None
    normals, weights, sample = _planes(points, params.max_normals)
    if weights.sum() <= 0:
        return turned.up if turned and turned.sure else None
    directions = fibonacci_sphere(8000)
    if turned is not None:
        near = directions[directions @ turned.up > np.cos(np.radians(turned.cone_deg))]
        up = _refine(near[np.argmax(_uprightness(near, normals, weights, params.kernel_deg))], normals, weights)
        return up if turned.sure or _side(sample, up, params) > 0 else None
    axes = _plane_axes(normals, weights, directions[directions[:, 2] >= 0], params)
    room = _up_of_room(sample, axes, params)
    if held is None or held.at_all_angles:
        return room
    told = _confirmed(held, sample, axes, room)
    return told if told is None or held.is_upright(told) or _side(sample, told, params) > 0 else None


def _confirmed(held: Held, points: np.ndarray, axes: list[np.ndarray], room: np.ndarray | None) -> np.ndarray | None:
    """The vertical of cameras on one heading: an axis of the scene's planes that the cameras' holding allows and a
    second witness names; None where two are named, or none."""
    named = [] if room is None else [room]
    for witness in (held.across_the_way(points), held.across_the_rows()):
        # What is known roughly, as the planes know it exactly. Along a facade by drone, or over the ground: where the
        # cameras look along the axis that a witness names, it bears none.
        of_planes = [] if witness is None else [a for a in axes if abs(a @ witness) > np.cos(np.radians(_COMMON_DEG))]
        if of_planes:
            axis = max(of_planes, key=lambda a: abs(a @ witness))
            if not held.looks_along(axis):
                named.append(axis if held.is_allowed(axis) else -axis)
    if not named or any(n @ named[0] < np.cos(np.radians(_COMMON_DEG)) for n in named):
        return None
    return named[0] if held.is_allowed(named[0]) else None


def _planes(points: np.ndarray, max_normals: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normals and weights of a sample of the surface, and the sample."""
    span = np.ptp(np.percentile(points, [2, 98], axis=0), axis=0)
    cell = float(np.sort(span)[1:].mean()) / 60 or 1.0
    sample, _ = downsample(points, points, cell)
    normals, planarity = local_planes(sample, 40)
    step = max(1, len(sample) // max_normals)
    return normals[::step], planarity[::step] ** 2, sample


def _uprightness(directions: np.ndarray, normals: np.ndarray, weights: np.ndarray, kernel_deg: float) -> np.ndarray:
    """Weight of the normals along each direction plus half of that of those across it, (D,)."""
    squared = (directions.astype(np.float32) @ normals.T.astype(np.float32)) ** 2
    sharp = np.float32(0.5 / np.radians(kernel_deg) ** 2)  # the sine of an angle stands for the angle
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


def _plane_axes(normals: np.ndarray, weights: np.ndarray, directions: np.ndarray, params: Params) -> list[np.ndarray]:
    """The axes of the strongest heaps of normals, strongest first, six at most."""
    score = _uprightness(directions, normals, weights, params.kernel_deg)
    axes: list[np.ndarray] = []
    for i in np.argsort(-score):
        if all(abs(directions[i] @ a) < np.cos(np.radians(20)) for a in axes):
            axes.append(directions[i])
        if len(axes) == 6:
            break
    return [_refine(a, normals, weights) for a in axes]


def _up_of_room(points: np.ndarray, axes: list[np.ndarray], params: Params) -> np.ndarray | None:
    """The vertical of a room by its shape alone, or None.

    A vertical has what no horizontal axis has: nearly every cell of the plan seen along it lies over a floor or under a
    ceiling, and the plan is large. None when floor and ceiling together cover too little of the plan (a part of a
    room), the best axis does not clearly beat the next, or the halves balance.
    """
    covers, shares = np.array([_plan_cover(points, a) for a in axes]).T
    best = int(np.argmax(covers))
    if shares[best] < params.min_plan_cover:
        return None
    others = [c for a, c in zip(axes, covers, strict=True) if abs(a @ axes[best]) < np.cos(np.radians(10))]
    if others and covers[best] < params.min_lead * max(others):
        return None
    side = _side(points, axes[best], params)
    return side * axes[best] if side else None


def _side(points: np.ndarray, axis: np.ndarray, params: Params) -> int:
    """1 where ``axis`` points up, -1 where down, 0 where that cannot be told: between floor and ceiling there is more
    surface in the lower half."""
    height = points @ axis
    low, high = np.percentile(height, [2, 98])
    t = (height - low) / max(high - low, 1e-12)
    below, above = np.sum((t > 0.1) & (t < 0.5)), np.sum((t > 0.5) & (t < 0.9))
    if max(below, above) < params.min_imbalance * min(below, above):
        return 0
    return 1 if below > above else -1


def _plan_cover(points: np.ndarray, axis: np.ndarray) -> tuple[float, float]:
    """How much of the plan seen along ``axis`` has surface on the lowest and on the highest plane.

    Returns:
        The mean area of the two, and the sum of both as shares of the plan.
    """
    local = points @ level_frame(axis).T
    low, high = np.percentile(local[:, 2], [2, 98])
    cell = float(np.ptp(points, axis=0).max()) / 60 or 1.0
    slab = 0.04 * (high - low)
    plan = _num_cells(local, cell)
    covered = sum(_num_cells(local[np.abs(local[:, 2] - plane) < slab], cell) for plane in (low, high))
    return 0.5 * covered * cell**2, covered / plan


def _num_cells(points: np.ndarray, cell: float) -> int:
    key = np.floor(points[:, :2] / cell).astype(np.int64)
    return len(np.unique(key[:, 0] * 2**32 + key[:, 1]))

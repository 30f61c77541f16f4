"""Estimate the vertical of a scene from its cameras and planes."""

from __future__ import annotations

import numpy as np

from gsmap.describe.camera_orientations import CameraOrientations, estimate_turn_axis
from gsmap.describe.cloud import downsample, local_planes
from gsmap.geometry.directions import fibonacci_sphere, level_frame
from gsmap.types import Cameras

_KERNEL_DEG = 4.0  # scatter of the normals of a floor or wall
_MAX_NORMALS = 6000  # the surface is thinned to about this many points
_MIN_PLAN_COVER = 0.7  # without cameras: smallest share of the plan that floor and ceiling cover together
_MIN_LEAD = 1.2  # without cameras: smallest ratio of the vertical's cover to the cover of the next axis
_MIN_IMBALANCE = 1.15  # without cameras: smallest ratio of the surface in the lower half to that in the upper half
_COMMON_DEG = 15.0  # directions nearer to each other than this may be the same


def estimate_up(points: np.ndarray, cameras: Cameras | None) -> np.ndarray | None:
    """Estimate the unit vector against gravity (3,) in the points' frame; return None if it is ambiguous.

    Cameras that rotate about the vertical determine it, whatever their pitch (`estimate_turn_axis`). Within a cone
    around their estimate, the result is the direction to which most surface normals are parallel
    (floors, tables, ceilings) or perpendicular (walls). Cameras with one heading leave the pitch open: what is a wall
    to a camera that looks ahead would be the ground to a camera that looks down. Then a second cue must confirm the
    same axis of the scene: the camera path, a small rotation, or the room (`_up_of_room`). Without cameras, or with
    synthesized ones, the room alone decides.

    Args:
        points: (N, 3) surface points in any unit.
        cameras: cameras in the frame of the points.
    """
    orientations = (
        None if cameras is None or cameras.synthesised or not len(cameras) else CameraOrientations.of(cameras)
    )
    turn = None if orientations is None else estimate_turn_axis(orientations)
    if len(points) < 200:
        return turn.up if turn and turn.sure else None
    normals, weights, sample = _planes(points)
    if weights.sum() <= 0:
        return turn.up if turn and turn.sure else None
    directions = fibonacci_sphere(8000)
    if turn is not None:
        near = directions[directions @ turn.up > np.cos(np.radians(turn.cone_deg))]
        up = _refine(near[np.argmax(_uprightness(near, normals, weights))], normals, weights)
        return up if turn.sure or _side(sample, up) > 0 else None
    axes = _plane_axes(normals, weights, directions[directions[:, 2] >= 0])
    room = _up_of_room(sample, axes)
    if orientations is None or orientations.at_all_angles:
        return room
    confirmed = _confirmed(orientations, sample, axes, room)
    accepted = confirmed is None or orientations.is_upright(confirmed) or _side(sample, confirmed) > 0
    return confirmed if accepted else None


def _confirmed(
    orientations: CameraOrientations, points: np.ndarray, axes: list[np.ndarray], room: np.ndarray | None
) -> np.ndarray | None:
    """Return the vertical for cameras with one heading: an axis of the scene's planes that the cameras allow and a
    second cue confirms. Return None if two axes are confirmed, or none."""
    named = [] if room is None else [room]
    for cue in (orientations.normal_of_path(points), orientations.normal_of_rows()):
        # Replace the rough cue by the exact axis of planes near it. If the cameras look along that axis (a drone along
        # a facade, or over the ground), the cue is invalid.
        of_planes = [] if cue is None else [a for a in axes if abs(a @ cue) > np.cos(np.radians(_COMMON_DEG))]
        if of_planes:
            axis = max(of_planes, key=lambda a: abs(a @ cue))
            if not orientations.looks_along(axis):
                named.append(axis if orientations.is_allowed(axis) else -axis)
    if not named or any(n @ named[0] < np.cos(np.radians(_COMMON_DEG)) for n in named):
        return None
    return named[0] if orientations.is_allowed(named[0]) else None


def _planes(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return normals, weights and points of a sample of the surface."""
    span = np.ptp(np.percentile(points, [2, 98], axis=0), axis=0)
    cell = float(np.sort(span)[1:].mean()) / 60 or 1.0
    sample, _ = downsample(points, points, cell)
    normals, planarity = local_planes(sample, 40)
    step = max(1, len(sample) // _MAX_NORMALS)
    return normals[::step], planarity[::step] ** 2, sample


def _uprightness(directions: np.ndarray, normals: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Score directions (D,): the weight of the normals along each direction, plus half of the weight of the normals
    across it."""
    squared = (directions.astype(np.float32) @ normals.T.astype(np.float32)) ** 2
    sharp = np.float32(0.5 / np.radians(_KERNEL_DEG) ** 2)  # the sine of an angle approximates the angle
    score = np.exp(-sharp * (1 - squared)) + 0.5 * np.exp(-sharp * squared)
    return score @ (weights / weights.sum()).astype(np.float32)


def _refine(up: np.ndarray, normals: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Refine the direction near ``up`` by a least-squares fit to the horizontal and vertical planes."""
    for kernel_deg in (4.0, 3.0, 2.0, 1.5, 1.5):
        angle = np.degrees(np.arccos(np.minimum(np.abs(normals @ up), 1)))
        along = weights * np.exp(-0.5 * (angle / kernel_deg) ** 2)
        across = weights * np.exp(-0.5 * ((90 - angle) / kernel_deg) ** 2)
        axis = np.linalg.eigh((normals * (0.5 * across - along)[:, None]).T @ normals)[1][:, 0]
        up = axis * (np.sign(axis @ up) or 1.0)
    return up


def _plane_axes(normals: np.ndarray, weights: np.ndarray, directions: np.ndarray) -> list[np.ndarray]:
    """Find the axes of the strongest clusters of normals, strongest first, at most six."""
    score = _uprightness(directions, normals, weights)
    axes: list[np.ndarray] = []
    for i in np.argsort(-score):
        if all(abs(directions[i] @ a) < np.cos(np.radians(20)) for a in axes):
            axes.append(directions[i])
        if len(axes) == 6:
            break
    return [_refine(a, normals, weights) for a in axes]


def _up_of_room(points: np.ndarray, axes: list[np.ndarray]) -> np.ndarray | None:
    """Estimate the vertical of a room from its shape alone; None if it is ambiguous.

    Seen along the vertical, unlike along a horizontal axis, nearly every cell of the plan lies over a floor or under a
    ceiling, and the plan is large. The vertical is ambiguous if floor and ceiling together cover too little of the plan
    (a part of a room), if the best axis is not clearly better than the next, or if both halves have about as much
    surface.
    """
    covers, shares = np.array([_plan_cover(points, a) for a in axes]).T
    best = int(np.argmax(covers))
    if shares[best] < _MIN_PLAN_COVER:
        return None
    others = [c for a, c in zip(axes, covers, strict=True) if abs(a @ axes[best]) < np.cos(np.radians(10))]
    if others and covers[best] < _MIN_LEAD * max(others):
        return None
    side = _side(points, axes[best])
    return side * axes[best] if side else None


def _side(points: np.ndarray, axis: np.ndarray) -> int:
    """Return 1 if ``axis`` points up, -1 if it points down, 0 if undecided: a room has more surface in its lower
    half."""
    height = points @ axis
    low, high = np.percentile(height, [2, 98])
    t = (height - low) / max(high - low, 1e-12)
    below, above = np.sum((t > 0.1) & (t < 0.5)), np.sum((t > 0.5) & (t < 0.9))
    if max(below, above) < _MIN_IMBALANCE * min(below, above):
        return 0
    return 1 if below > above else -1


def _plan_cover(points: np.ndarray, axis: np.ndarray) -> tuple[float, float]:
    """Measure how much of the plan seen along ``axis`` the lowest and the highest plane cover.

    Returns:
        The mean area of both planes, and the sum of their shares of the plan.
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

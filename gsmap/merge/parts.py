"""What goes into a merge and what comes out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.types import Cameras, Gaussians


@dataclass(frozen=True, eq=False)
class Part:
    """One capture, or the piece of it that lies near a tile, in the map frame.

    Args:
        gaussians: its Gaussians, map frame.
        cameras: its cameras, map frame; None or none where nothing is known of what it saw.
        scene_id: which scene it is; parts are merged in the order of their ids, whatever order they come in.
        captured_at: ISO 8601 time with zone, or None.
        centroid: (3,) mean of the whole capture's means, map frame, where `gaussians` is only a piece of it.
    """

    gaussians: Gaussians
    cameras: Cameras | None = None
    scene_id: str = ""
    captured_at: str | None = None
    centroid: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class MergeResult:
    """The merged Gaussians and where they came from.

    Args:
        gaussians: in the map frame, only those whose mean lies in the bounds asked for.
        origin: (N,) int32 index, in the order the parts were given, of the part each Gaussian came from (of the
            heaviest one, where several became one).
        num_input: Gaussians of all parts within the bounds before merging.
        steps: optimisation steps taken, 0 for the closed-form methods.
        truncated: a time budget cut the optimisation short.
        notes: what a person should know.
    """

    gaussians: Gaussians
    origin: np.ndarray
    num_input: int = 0
    steps: int = 0
    truncated: bool = False
    notes: tuple[str, ...] = ()


def inside(points: np.ndarray, bounds: np.ndarray | None, margin: float = 0.0) -> np.ndarray:
    """(N,) which points (N, 3) lie in bounds (2, 3) grown by a margin (``low <= x < high``); all if None."""
    if bounds is None:
        return np.ones(len(points), dtype=bool)
    return ((points >= bounds[0] - margin) & (points < bounds[1] + margin)).all(1)


def pulled_inside(points: np.ndarray, bounds: np.ndarray | None) -> np.ndarray:
    """Float32 points (N, 3) moved to the nearest place that `inside` calls inside."""
    if bounds is None:
        return points
    low, high = bounds.astype(np.float32)
    low = np.where(low < bounds[0], np.nextafter(low, np.float32(np.inf)), low)
    high = np.where(high >= bounds[1], np.nextafter(high, np.float32(-np.inf)), high)
    return np.clip(points, low, high)


def united(parts: list[Part]) -> tuple[Gaussians, np.ndarray]:
    """All Gaussians of the parts in order, and the index (N,) int32 of the part of each."""
    origin = np.repeat(np.arange(len(parts), dtype=np.int32), [len(p.gaussians) for p in parts])
    return Gaussians.concatenate([p.gaussians for p in parts]), origin


def overlapping(a: Part, b: Part) -> bool:
    """Whether the boxes around two parts' means meet: cheap, and spares comparing captures of different places."""
    if len(a.gaussians) == 0 or len(b.gaussians) == 0:
        return False
    low = np.maximum(a.gaussians.means.min(0), b.gaussians.means.min(0))
    return bool((low <= np.minimum(a.gaussians.means.max(0), b.gaussians.means.max(0))).all())


def share_in_view(cameras: Cameras, points: np.ndarray, sample: int = 2000) -> np.ndarray:
    """(C,) share of points (N, 3) that lie in front of each camera and in its picture, from an even sample of them."""
    points = points[:: max(1, len(points) // sample)].astype(np.float64)
    if len(points) == 0:
        return np.zeros(len(cameras))
    T = cameras.T_camera_frame
    local = np.einsum("cij,nj->cni", T[:, :3, :3], points) + T[:, None, :3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixel = (
            local[..., :2] / local[..., 2:] * cameras.intrinsics_px[:, None, :2] + cameras.intrinsics_px[:, None, 2:]
        )
        seen = (local[..., 2] > 0) & (pixel > 0).all(-1) & (pixel < cameras.sizes_px[:, None]).all(-1)
    return seen.mean(1)

"""What two scenes say of each other once one is laid into the other: the evidence only splats have."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.register.surface import Surface
from gsmap.types import Cameras, Sim3


@dataclass(frozen=True)
class Params:
    """Args (metres, pixels):
    radius_m: surfaces closer than this coincide.
    depth_tolerance_m: a point nearer than what a camera saw by more than this contradicts it.
    num_cameras: cameras of each scene that are asked, chosen to see most of the other scene.
    image_size_px: longer side of the depth images.
    cell_m: colours are compared after their mean over cells of this size is removed.
    max_points: points of each scene that are tested.
    """

    radius_m: float = 0.08
    depth_tolerance_m: float = 0.10
    num_cameras: int = 6
    image_size_px: int = 96
    cell_m: float = 0.4
    max_points: int = 12_000


@dataclass(frozen=True)
class Agreement:
    """Evidence for or against a pose.

    Args:
        overlap: share of surface cells that coincide, the smaller of both directions.
        num_coinciding: source cells that coincide with the target.
        contradiction: share of the points seen that stand in front of what the other scene's cameras saw; the larger of
            both directions. NaN where no camera could be asked.
        num_seen: points that cameras could judge, the smaller of both directions.
        colour_correlation: correlation of colours between coinciding surfaces, differences within ``cell_m`` only, so
            neither exposure nor "floors are dark, walls are bright" counts; mean over lightness and two chromas.
        colour_t: its significance, in standard deviations over cells.
    """

    overlap: float
    num_coinciding: int
    contradiction: float
    num_seen: int
    colour_correlation: float
    colour_t: float


def measure(
    target: Surface,
    source: Surface,
    pose: Sim3,
    cameras: tuple[Cameras | None, Cameras | None] = (None, None),
    params: Params | None = None,
) -> Agreement:
    """Compare two surfaces (metres) under ``S_target_source``; cameras are each scene's own, in metres too."""
    params = params or Params()
    rows_t, rows_s = target.sample(params.max_points), source.sample(params.max_points)
    forward, back = pose.apply(source.coarse[0][rows_s]), pose.inverse().apply(target.coarse[0][rows_t])
    distance, row = target.nearest(forward, params.radius_m)
    hit = np.isfinite(distance)
    other, _ = source.nearest(back, params.radius_m)
    overlap = min(float(hit.mean()), float(np.isfinite(other).mean())) if len(hit) and len(other) else 0.0
    correlation, t = _colour_agreement(
        target.coarse[1][row[hit]], source.coarse[1][rows_s[hit]], forward[hit], params.cell_m
    )
    ratios, seen = zip(
        *(
            _contradiction(surface, views, points, params)
            for surface, views, points in ((target, cameras[0], forward), (source, cameras[1], back))
        ),
        strict=True,
    )
    known = [r for r in ratios if np.isfinite(r)]
    return Agreement(overlap, int(hit.sum()), max(known) if known else float("nan"), min(seen), correlation, t)


def _colour_agreement(a: np.ndarray, b: np.ndarray, points: np.ndarray, cell_m: float) -> tuple[float, float]:
    """Correlation (mean of three channels) of local colour differences, and its t statistic over cells."""
    if len(a) < 20:
        return 0.0, 0.0
    opponent = np.array([[0.299, 0.587, 0.114], [1.0, -1.0, 0.0], [0.5, 0.5, -1.0]]).T
    _, cell, counts = np.unique(np.floor(points / cell_m).astype(int), axis=0, return_inverse=True, return_counts=True)
    cell = cell.ravel()

    def local(colours: np.ndarray) -> np.ndarray:
        values = colours @ opponent
        means = np.stack([np.bincount(cell, v) for v in values.T], 1) / counts[:, None]
        values = values - means[cell]
        return values / (np.sqrt((values**2).mean(0)) + 1e-9)

    products = (local(a) * local(b)).mean(1)
    sums = np.bincount(cell, products)
    return float(products.mean()), float(sums.sum() / (np.sqrt((sums**2).sum()) + 1e-9))


def _contradiction(surface: Surface, cameras: Cameras | None, points: np.ndarray, params: Params) -> tuple[float, int]:
    """Share of ``points`` in front of what the surface's own cameras saw of it, and how many could be judged."""
    if cameras is None or not len(cameras) or not len(points) or not len(surface):
        return float("nan"), 0
    cameras = cameras.resized(params.image_size_px)
    views = cameras.T_camera_frame
    agree, contradict = np.zeros(len(points), bool), np.zeros(len(points), bool)
    own = surface.points.astype(np.float32)
    for c in choose_cameras(cameras, points, params.num_cameras):
        width, height = cameras.sizes_px[c]
        pixel, z, at = _project(own, views[c], cameras.intrinsics_px[c], width, height)
        nearest = np.full(width * height, np.inf, np.float32)
        np.minimum.at(nearest, pixel, z)
        low, high = _extremes(nearest.reshape(height, width))
        pixel, z, at = _project(points.astype(np.float32), views[c], cameras.intrinsics_px[c], width, height)
        # Both bounds over 3 x 3 pixels: a pixel off at an edge, or a hole between points, is no contradiction.
        near, far = low.ravel()[pixel], high.ravel()[pixel]
        seen = np.isfinite(near)
        contradict[at[seen & (z < near - params.depth_tolerance_m)]] = True
        agree[at[seen & (z >= near - params.depth_tolerance_m) & (z <= far + params.depth_tolerance_m)]] = True
    judged = int((agree | contradict).sum())
    return (float((contradict & ~agree).sum()) / judged if judged else float("nan")), judged


def choose_cameras(cameras: Cameras, points: np.ndarray, count: int) -> list[int]:
    """Greedy choice of the cameras with most of the points in front of them, each point counted once."""
    sample = points[np.linspace(0, len(points) - 1, min(len(points), 400)).astype(int)].astype(np.float32)
    inside = np.zeros((len(cameras), len(sample)), dtype=bool)
    for c, view in enumerate(cameras.T_camera_frame):
        inside[c, _project(sample, view, cameras.intrinsics_px[c], *cameras.sizes_px[c])[2]] = True
    left, chosen = np.ones(len(sample), dtype=bool), []
    for _ in range(min(count, len(cameras))):
        gain = (inside & left).sum(1)
        best = int(gain.argmax())
        if not gain[best]:
            break
        chosen.append(best)
        left &= ~inside[best]
    return chosen


def _project(
    points: np.ndarray, view: np.ndarray, intrinsics: np.ndarray, width: int, height: int, near_m: float = 0.15
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Flat pixel index, depth and row of the points that fall into an image."""
    local = points @ view[:3, :3].T.astype(np.float32) + view[:3, 3].astype(np.float32)
    at = np.flatnonzero(local[:, 2] > near_m)
    local = local[at]
    z = local[:, 2]
    u = np.floor(local[:, 0] / z * intrinsics[0] + intrinsics[2])
    v = np.floor(local[:, 1] / z * intrinsics[1] + intrinsics[3])
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    return (v[inside] * width + u[inside]).astype(np.int64), z[inside], at[inside]


def _extremes(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest depth over 3 x 3 pixels; pixels that saw nothing count as neither."""
    from scipy.ndimage import maximum_filter, minimum_filter

    low = minimum_filter(depth, 3, mode="nearest")
    return low, maximum_filter(np.where(np.isfinite(depth), depth, -np.inf), 3, mode="nearest")

"""Where captures disagree because the place changed, the newer one wins."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np

from gsmap.merge.parts import Part, overlapping
from gsmap.render import render
from gsmap.types import Cameras, Gaussians

_LONGEST_SIDE_PX = 240
_GAP = (0.1, 0.03)  # metres, and share of the depth: how far in front of a surface a thing must be to be gone
_MIN_OPACITY = 0.9
_MIN_VIEWS = 3
_NEAREST_M = 0.2
_MIN_SHARE = 0.6  # of the views that could see it


def drop_what_is_gone(parts: list[Part]) -> tuple[list[Part], list[int]]:
    """The parts without the Gaussians that a later capture looked straight through, and how many each lost.

    A Gaussian is gone when, in most of the later capture's own views that have it in frame and unoccluded, and in at
    least a few of them, the later capture shows an opaque surface clearly behind it. What the later capture never saw
    stays. Captures without a time, or of the same time, overrule nothing.
    """
    kept, lost = [], []
    for part, later in zip(parts, _later(parts), strict=True):
        gone = np.zeros(len(part.gaussians), dtype=bool)
        for newer in later:
            through, on_surface = _evidence(part.gaussians.means, newer)
            gone |= (through >= _MIN_VIEWS) & (through >= _MIN_SHARE * (through + on_surface))
        kept.append(replace(part, gaussians=part.gaussians[~gone]) if gone.any() else part)
        lost.append(int(gone.sum()))
    return kept, lost


def what_came_later(parts: list[Part]) -> list[list[Gaussians]]:
    """For each part, what its later captures are sure of: the Gaussians their own views show as a surface."""
    sure: dict[int, Gaussians] = {}
    for newer in {id(p): p for later in _later(parts) for p in later}.values():
        _, on_surface = _evidence(newer.gaussians.means, newer)
        sure[id(newer)] = newer.gaussians[on_surface >= _MIN_VIEWS]
    return [[sure[id(p)] for p in later] for later in _later(parts)]


def overruled_pixels(camera: Cameras, depth: np.ndarray, later: list[Gaussians]) -> np.ndarray:
    """(H, W) bool, where a later capture is sure of a surface clearly in front of the depth map of one camera."""
    overruled = np.zeros(depth.shape, dtype=bool)
    for gaussians in later:
        seen = render(gaussians, camera)
        clearly = seen.depth[0] < depth - (_GAP[0] + _GAP[1] * depth)
        overruled |= (seen.alpha[0] > _MIN_OPACITY) & clearly
    return overruled


def _later(parts: list[Part]) -> list[list[Part]]:
    """For each part, the parts of the same place that were captured after it and have cameras."""
    times = [_time(part.captured_at) for part in parts]
    return [
        [
            other
            for other, then in zip(parts, times, strict=True)
            if time and then and then > time and other.cameras is not None and overlapping(part, other)
        ]
        for part, time in zip(parts, times, strict=True)
    ]


def _evidence(means: np.ndarray, newer: Part) -> tuple[np.ndarray, np.ndarray]:
    """How many views of a capture show an opaque surface (N,) clearly behind each point, and (N,) at it."""
    points = means.astype(np.float64)
    through, on_surface = np.zeros(len(points), dtype=np.int32), np.zeros(len(points), dtype=np.int32)
    cameras = newer.cameras.resized(_LONGEST_SIDE_PX)
    for c in range(len(cameras)):
        T = cameras.T_camera_frame[c]
        local = points @ T[:3, :3].T + T[:3, 3]
        fx, fy, cx, cy = cameras.intrinsics_px[c]
        width, height = cameras.sizes_px[c]
        ahead = local[:, 2] > _NEAREST_M
        z = np.where(ahead, local[:, 2], 1.0)
        column = np.floor(fx * local[:, 0] / z + cx)
        row = np.floor(fy * local[:, 1] / z + cy)
        rows = np.flatnonzero(ahead & (column >= 0) & (column < width) & (row >= 0) & (row < height))
        if len(rows) == 0:
            continue
        seen = render(newer.gaussians, cameras[c])
        pixel = row[rows].astype(int), column[rows].astype(int)
        surface, opaque = seen.depth[0][pixel], seen.alpha[0][pixel] > _MIN_OPACITY
        behind = surface - z[rows]
        gap = _GAP[0] + _GAP[1] * surface
        through[rows] += opaque & (behind > gap)
        on_surface[rows] += opaque & (np.abs(behind) <= gap)
    return through, on_surface


def _time(text: str | None) -> datetime | None:
    if not text:
        return None
    time = datetime.fromisoformat(text)
    return time if time.tzinfo else time.replace(tzinfo=UTC)

"""Where captures disagree because the place changed, the newer one wins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime

import numpy as np

from gsmap.geometry.projection import in_image, project
from gsmap.merge.placed import overlapping
from gsmap.render import render
from gsmap.types import Cameras, Gaussians, PlacedScene


@dataclass(frozen=True)
class Params:
    """What counts as evidence that a later capture looked through a place.

    Args:
        longest_side_px: size of the later capture's views that are rendered.
        gap_m: a thing must be this far in front of the surface that the later capture shows to be gone, and
        gap_share: this share of the surface's depth more.
        min_opacity: alpha from which on a pixel shows a surface.
        min_views: views of the later capture that must agree.
        min_share: of the views that could see it, these must look through it.
        nearest_m: what is nearer to a camera than this is not judged by it.
    """

    longest_side_px: int = 240
    gap_m: float = 0.1
    gap_share: float = 0.03
    min_opacity: float = 0.9
    min_views: int = 3
    min_share: float = 0.6
    nearest_m: float = 0.2


def remove_disappeared(
    scenes: Sequence[PlacedScene], params: Params | None = None
) -> tuple[list[PlacedScene], list[int]]:
    """The scenes without the Gaussians that a later capture looked straight through, and how many each lost.

    A Gaussian is gone when, in most of the later capture's own views that have it in frame and unoccluded, and in at
    least a few of them, the later capture shows an opaque surface clearly behind it. What the later capture never saw
    stays. Captures without a time, or of the same time, overrule nothing.
    """
    params = params or Params()
    kept, lost = [], []
    for scene, newer in zip(scenes, _newer(scenes), strict=True):
        gone = np.zeros(len(scene.gaussians), dtype=bool)
        for other in newer:
            through, on_surface = _evidence(scene.gaussians.means, other, params)
            gone |= (through >= params.min_views) & (through >= params.min_share * (through + on_surface))
        kept.append(replace(scene, gaussians=scene.gaussians[~gone]) if gone.any() else scene)
        lost.append(int(gone.sum()))
    return kept, lost


def newer_surfaces(scenes: Sequence[PlacedScene], params: Params | None = None) -> list[list[Gaussians]]:
    """For each scene, what its later captures are sure of: the Gaussians their own views show as a surface."""
    params = params or Params()
    newer = _newer(scenes)
    sure: dict[int, Gaussians] = {}
    for other in {id(s): s for others in newer for s in others}.values():
        _, on_surface = _evidence(other.gaussians.means, other, params)
        sure[id(other)] = other.gaussians[on_surface >= params.min_views]
    return [[sure[id(s)] for s in others] for others in newer]


def overruled_pixels(
    camera: Cameras, depth: np.ndarray, newer: Sequence[Gaussians], params: Params | None = None
) -> np.ndarray:
    """(H, W) bool, where a later capture is sure of a surface clearly in front of the depth map of one camera."""
    params = params or Params()
    overruled = np.zeros(depth.shape, dtype=bool)
    for gaussians in newer:
        seen = render(gaussians, camera)
        clearly = seen.depth[0] < depth - (params.gap_m + params.gap_share * depth)
        overruled |= (seen.alpha[0] > params.min_opacity) & clearly
    return overruled


def _newer(scenes: Sequence[PlacedScene]) -> list[list[PlacedScene]]:
    """For each scene, the scenes of the same place that were captured after it and have cameras."""
    times = [_time(scene.captured_at) for scene in scenes]
    return [
        [
            other
            for other, then in zip(scenes, times, strict=True)
            if time and then and then > time and other.cameras is not None and overlapping(scene, other)
        ]
        for scene, time in zip(scenes, times, strict=True)
    ]


def _evidence(means: np.ndarray, newer: PlacedScene, params: Params) -> tuple[np.ndarray, np.ndarray]:
    """How many views of a capture show an opaque surface (N,) clearly behind each point, and (N,) at it."""
    points = means.astype(np.float64)
    through, on_surface = np.zeros(len(points), dtype=np.int32), np.zeros(len(points), dtype=np.int32)
    if newer.cameras is None:
        return through, on_surface
    cameras = newer.cameras.resized(params.longest_side_px)
    for c in range(len(cameras)):
        pixels, z = project(points, cameras.T_camera_frame[c], cameras.intrinsics_px[c])
        rows = np.flatnonzero(in_image(pixels, z, cameras.sizes_px[c], near=params.nearest_m))
        if len(rows) == 0:
            continue
        seen = render(newer.gaussians, cameras[c])
        column, row = pixels[rows].astype(int).T
        surface, opaque = seen.depth[0][row, column], seen.alpha[0][row, column] > params.min_opacity
        behind = surface - z[rows]
        gap = params.gap_m + params.gap_share * surface
        through[rows] += opaque & (behind > gap)
        on_surface[rows] += opaque & (np.abs(behind) <= gap)
    return through, on_surface


def _time(text: str | None) -> datetime | None:
    if not text:
        return None
    time = datetime.fromisoformat(text)
    return time if time.tzinfo else time.replace(tzinfo=UTC)

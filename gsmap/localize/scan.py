"""Convert a scan to Gaussians, so that it can be registered like a capture."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gsmap.formats.scans import Params as ReadingParams
from gsmap.geometry.cells import cell_labels, group_means
from gsmap.geometry.neighbours import chunks_of_neighbours
from gsmap.geometry.rotations import matrices_to_quats
from gsmap.geometry.sh import sh0_of_rgb
from gsmap.settings.ranges import require_range
from gsmap.types import Gaussians
from gsmap.types.scan import Scan

NEUTRAL = 0.5
"""Grey value of scans without colours."""

MAX_POINTS = 250_000
"""Largest number of Gaussians of a scan; the cells of a larger scan grow until no more are left."""

AGREE_SIGMAS = 5.0
"""Poses of two scenes contradict each other if they differ by more than this many standard deviations and by more than
the\ntolerances of one pose in `gsmap.register.pose_selection`."""

_NEIGHBOURS = 10  # nearest points that give the normal and the spacing of a point
_RADIUS_FRACTION = 0.7  # standard deviation of a disc in its plane, relative to the spacing of the points
_FLATNESS = 0.1  # thickness of a disc, relative to the standard deviation in its plane
_OPAQUE_LOGIT = 7.0  # an opacity of 0.999, which renderers treat as 1
_CELL_GROWTH = 2.0**0.5  # a cell of twice the area has half as many points


@dataclass(frozen=True)
class Params:
    """Settings for localizing a scan.

    Args:
        cell_m: Edge length in metres, positive, of the cells over which points of a scan are averaged; larger is faster
            and coarser.
        max_scenes_by_shape: Largest number of scenes, at least 1, that a scan without colours is compared with; larger
            localizes more scans and takes longer.
        reading: Limits of the process that reads the file.
    """

    cell_m: float = 0.02
    max_scenes_by_shape: int = 24
    reading: ReadingParams = field(default_factory=ReadingParams)

    def __post_init__(self) -> None:
        require_range(self, "(0, inf]", "cell_m", "max_scenes_by_shape")


def as_gaussians(scan: Scan, cell: float, max_points: int = MAX_POINTS) -> Gaussians:
    """Return a flat, opaque disc for every occupied cell of a scan, in the frame and unit of the scan's points.

    A disc lies in the plane of the nearest points (the two larger principal axes of their spread; Hoppe et al. 1992)
    and is as wide as the spacing of these points, so that evenly sampled surfaces are closed. Colours have SH degree 0;
    they are `NEUTRAL` grey if the scan has no colours.

    Args:
        cell: edge length of the cells, in the unit of the scan.
        max_points: cells grow until at most this many are occupied.
    """
    points, colours = _average_over_cells(scan, cell, max_points)
    quats, spacing = _fit_planes(points)
    wide = np.log(_RADIUS_FRACTION * spacing)
    log_scales = np.stack([wide, wide, wide + np.log(_FLATNESS)], axis=1)
    logits = np.full(len(points), _OPAQUE_LOGIT)
    return Gaussians(points, quats, log_scales, logits, sh0_of_rgb(colours)[:, None])


def _average_over_cells(scan: Scan, cell: float, max_points: int) -> tuple[np.ndarray, np.ndarray]:
    """Average points (N, 3) and colours (N, 3) over cells, which grow until at most ``max_points`` are left."""
    colours = np.full((len(scan), 3), NEUTRAL) if scan.colours is None else scan.colours.astype(np.float64)
    while True:
        labels, counts = cell_labels(np.floor(scan.points / cell))
        if len(counts) <= max_points:
            break
        cell *= max(_CELL_GROWTH, (len(counts) / max_points) ** 0.5)
    means = group_means(np.concatenate([scan.points, colours], axis=1), labels, counts)
    return means[:, :3], means[:, 3:]


def _fit_planes(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations (N, 4) whose third axis is the normal of the plane of the nearest points, and the spacing (N,)
    of the points."""
    count = min(_NEIGHBOURS + 1, len(points))
    quats, spacing = np.zeros((len(points), 4)), np.zeros(len(points))
    for rows, distances, near in chunks_of_neighbours(points, count):
        distances, near = distances.reshape(-1, count), near.reshape(-1, count)
        around = points[near] - points[near].mean(1, keepdims=True)
        axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][:, :, ::-1].copy()
        axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]
        quats[rows] = matrices_to_quats(axes)
        spacing[rows] = np.median(distances[:, 1 : 1 + (count // 2 or 1)], axis=1) if count > 1 else 1.0
    middle = float(np.median(spacing)) or 1.0
    # Without limits, outliers would become huge discs and duplicates would have no size.
    return quats, np.clip(spacing, 0.5 * middle, 2.0 * middle)

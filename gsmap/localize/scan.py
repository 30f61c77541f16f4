"""A scan as Gaussians, so that everything that looks at captures can look at it."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np

from gsmap.errors import ConfigError
from gsmap.formats.scans import Params as ReadingParams
from gsmap.geometry.cells import cell_labels, group_means
from gsmap.geometry.neighbours import chunks_of_neighbours
from gsmap.geometry.rotations import matrices_to_quats
from gsmap.geometry.sh import sh0_of_rgb
from gsmap.types import Gaussians
from gsmap.types.scan import Scan

NEUTRAL = 0.5
"""The grey of what has no colour."""

_OPAQUE_LOGIT = 7.0  # an opacity of 0.999: 1, as far as any renderer can tell
_COARSER = 2.0**0.5  # a cell of twice the area has half as many points


@dataclass(frozen=True)
class Params:
    """How a scan is looked for in a map.

    Args:
        cell_m: points are averaged over cells of this size, and over larger ones ...
        max_points: ... until no more are left than this.
        neighbours: that a normal and a spacing are told from.
        spread: standard deviation of a disc in its plane, as a share of the spacing of the points around it.
        flatness: and across it, as a share of that.
        enough: scenes in which a scan is found at one place, after which no further ones are asked.
        most_by_shape: scenes that a scan without colours is compared with at most.
        agree_sigmas: places that two scenes give contradict each other beyond so many standard deviations, and beyond
            what `register.same_pose` takes for one.
        reading: how files are read.
    """

    cell_m: float = 0.02
    max_points: int = 250_000
    neighbours: int = 10
    spread: float = 0.7
    flatness: float = 0.1
    enough: int = 3
    most_by_shape: int = 24
    agree_sigmas: float = 5.0
    reading: ReadingParams = field(default_factory=ReadingParams)

    def __post_init__(self) -> None:
        for one in fields(self):
            value = getattr(self, one.name)
            if one.name != "reading" and not value > 0:
                raise ConfigError(f"scan.{one.name} must be positive, got {value}")


def as_gaussians(scan: Scan, unit_m: float, params: Params | None = None) -> Gaussians:
    """A flat, opaque disc for every cell of a scan, in the frame and unit of its points.

    A disc lies in the plane of the nearest points (the two larger principal axes of their spread; Hoppe et al. 1992)
    and is as wide as they are apart, so that a surface is closed wherever it was sampled evenly. Colours are of SH
    degree 0; `NEUTRAL` grey where the scan has none.

    Args:
        unit_m: metres per unit, which the cells are of.
    """
    params = params or Params()
    points, colours = _thinned(scan, params.cell_m / unit_m, params.max_points)
    quats, spacing = _planes(points, params.neighbours)
    wide = np.log(params.spread * spacing)
    log_scales = np.stack([wide, wide, wide + np.log(params.flatness)], axis=1)
    logits = np.full(len(points), _OPAQUE_LOGIT)
    return Gaussians(points, quats, log_scales, logits, sh0_of_rgb(colours)[:, None])


def _thinned(scan: Scan, cell: float, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Means of points and colours over cells, no more than so many."""
    colours = np.full((len(scan), 3), NEUTRAL) if scan.colours is None else scan.colours.astype(np.float64)
    while True:
        labels, counts = cell_labels(np.floor(scan.points / cell))
        if len(counts) <= most:
            break
        cell *= max(_COARSER, (len(counts) / most) ** 0.5)
    means = group_means(np.concatenate([scan.points, colours], axis=1), labels, counts)
    return means[:, :3], means[:, 3:]


def _planes(points: np.ndarray, neighbours: int) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (N, 4) whose third axis is the normal of the nearest points, and the spacing (N,) of these."""
    count = min(neighbours + 1, len(points))
    quats, spacing = np.zeros((len(points), 4)), np.zeros(len(points))
    for rows, distances, near in chunks_of_neighbours(points, count):
        distances, near = distances.reshape(-1, count), near.reshape(-1, count)
        around = points[near] - points[near].mean(1, keepdims=True)
        axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][:, :, ::-1].copy()
        axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]
        quats[rows] = matrices_to_quats(axes)
        spacing[rows] = np.median(distances[:, 1 : 1 + (count // 2 or 1)], axis=1) if count > 1 else 1.0
    middle = float(np.median(spacing)) or 1.0
    # A stray far from all others is no large disc, and two points on one another are no point.
    return quats, np.clip(spacing, 0.5 * middle, 2.0 * middle)

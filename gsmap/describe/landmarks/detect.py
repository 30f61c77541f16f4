"""Detect landmarks: typed blobs of colour and density of the surface, without rendering and without networks.

The input is a *levelled* cloud: it is in metres (by the given unit), with z against gravity. Landmarks depend on that
cloud alone, and not on the frame and unit of the capture.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from gsmap._native import LandmarkWorkspace, landmark_extrema
from gsmap.geometry.neighbours import spatial_order
from gsmap.types.views import PointCloud

CELL_M = 0.025  # cell of the finest octave, metres by the layer's unit; its blobs have a scale of 1.6 cells
NUM_OCTAVES = 4  # number of scales, each twice the last; scales finer than the capture's Gaussians are skipped
MAX_PER_OCTAVE = 1500  # default of the setting
_MAX_SPACING_CELLS = 1.4  # an octave is skipped if points are typically farther from their 8th neighbour
# Smallest contrast of the channels: 2 L*a*b* units in a and b, 1.3 times as much in L, and the excess over the surface
# of a plane for density.
_THRESHOLDS = np.array([1.3 * 2.0, 2.0, 2.0, 0.6])
_SIGMA_CELLS = 1.6  # blob scale in cells of its octave's grid
_SURROUND = 1.8  # scale of the surround relative to the blob's scale
_ORDER_ACROSS = 256  # cells across in the order in which points are spread over grids
_HALO_CELLS = 12  # reach of the surround's kernel and of the maxima
_BLOCK_CELLS = 192  # grids larger than this are processed in blocks, which bounds memory


@dataclass(frozen=True, eq=False)
class Blobs:
    """M blobs in the levelled frame, the strongest first.

    Args:
        positions: (M, 3) positions in metres.
        types: (M,) integer type ``(channel * 2 + negative) * octaves + octave``, with the channels L, a, b, density.
        responses: (M,) response in multiples of the channel's threshold.
        sigmas_m: (M,) scale of the blob in metres.
    """

    positions: np.ndarray
    types: np.ndarray
    responses: np.ndarray
    sigmas_m: np.ndarray

    def __len__(self) -> int:
        return len(self.positions)


class OctaveCache:
    """Cache of one cloud with its z axis up and of its extrema for each grid cell size, shared by layers.

    Layers whose units differ by a power of two use the same grids, bit by bit.
    """

    def __init__(self) -> None:
        self._levelled: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
        self._found: dict[object, list[tuple[int, int, np.ndarray, np.ndarray]]] = {}
        self._work: LandmarkWorkspace | None = None

    def levelled(self, cloud: PointCloud, level: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return points, L*a*b* and areas of the cloud, rotated by ``level`` (3, 3), in spatial order, which is
        cache-friendly. Every call must pass the same cloud."""
        if self._levelled is None:
            points = cloud.points @ level.T
            order = spatial_order(points, _ORDER_ACROSS)
            self._levelled = points.take(order, axis=0), cloud.lab.take(order, axis=0), cloud.areas[order]
        return self._levelled

    def extrema(
        self, points: np.ndarray, lab: np.ndarray, areas: np.ndarray, thresholds: np.ndarray, size: float
    ) -> list[tuple[int, int, np.ndarray, np.ndarray]]:
        """Compute `_extrema` of a grid with cells of ``size``, in the unit of the points."""
        key = size, thresholds.tobytes()
        if key not in self._found:
            self._work = self._work or LandmarkWorkspace()
            self._found[key] = list(_extrema(points, lab, areas, thresholds, size, self._work))
        return self._found[key]

    def free_workspace(self) -> None:
        """Free the memory of grids, when those of all layers were computed."""
        self._work = None


def find_blobs(
    points: np.ndarray,
    lab: np.ndarray,
    areas: np.ndarray,
    max_per_octave: int = MAX_PER_OCTAVE,
    octaves: OctaveCache | None = None,
    unit_m: float = 1.0,
) -> Blobs:
    """Detect extrema of colour and density relative to their surround, at 1.6 cells and one scale per octave.

    Points are spread over the grid with their areas as weights, so that neither the grid's origin nor the density of
    the Gaussians matters. Colour at a scale is a normalized Gaussian convolution; its response is the difference
    between the scales s and 1.8 s. Density is the surface near a point relative to that of a plane
    (``m sqrt(2 pi) s``): corners, clutter and thin objects stand out. A blob's position is the mean, weighted by
    response, of the cells around the extremum whose response exceeds 0.6 of the peak. Octaves finer than the points are
    skipped.

    Args:
        points, lab, areas: (N, 3) points of the levelled cloud, (N, 3) L*a*b*, and (N,) areas, in the cloud's unit.
        octaves: cache of this cloud.
        unit_m: metres per unit of the cloud.
    """
    known = octaves or OctaveCache()
    spacing_m = np.sqrt(8 / np.pi * np.median(areas)) * unit_m
    found = [_empty()]
    for octave in range(NUM_OCTAVES):
        size_m = CELL_M * 2**octave
        if spacing_m > _MAX_SPACING_CELLS * size_m:
            continue
        parts = [_empty()]
        for channel, negative, cells, ratio in known.extrema(points, lab, areas, _THRESHOLDS, size_m / unit_m):
            kind = np.full(len(cells), (channel * 2 + negative) * NUM_OCTAVES + octave, np.int32)
            parts.append(Blobs(cells * size_m, kind, ratio, np.full(len(cells), _SIGMA_CELLS * size_m)))
        found.append(_strongest(parts, max_per_octave))
    return _strongest(found)


def _empty() -> Blobs:
    return Blobs(np.zeros((0, 3)), np.zeros(0, np.int32), np.zeros(0), np.zeros(0))


def _strongest(parts: list[Blobs], count: int | None = None) -> Blobs:
    columns = [
        np.concatenate([getattr(p, name) for p in parts]) for name in ("positions", "types", "responses", "sigmas_m")
    ]
    order = np.argsort(-columns[2], kind="stable")[:count]
    return Blobs(*(c[order] for c in columns))


def _extrema(
    points: np.ndarray,
    lab: np.ndarray,
    areas: np.ndarray,
    thresholds: np.ndarray,
    size: float = 1.0,
    work: LandmarkWorkspace | None = None,
) -> Iterator[tuple[int, int, np.ndarray, np.ndarray]]:
    """Yield channel, sign (1 for negative), positions (n, 3) in cells of ``size``, and responses (n,) in multiples of
    the threshold."""
    table = landmark_extrema(
        work=LandmarkWorkspace() if work is None else work,
        points=np.ascontiguousarray(points, np.float64),
        lab=np.ascontiguousarray(lab, np.float32),
        areas=np.ascontiguousarray(areas, np.float64),
        thresholds=thresholds,
        size=size,
        square=size**2,
        edge=_BLOCK_CELLS,
        halo=_HALO_CELLS,
        sigma=_SIGMA_CELLS,
        surround=_SURROUND,
    )
    for channel in range(4):
        for negative in (0, 1) if channel < 3 else (0,):
            own = (table[:, 0] == channel) & (table[:, 1] == negative)
            yield channel, negative, table[own, 2:5], table[own, 5]

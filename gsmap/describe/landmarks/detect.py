"""Landmark nodes: typed colour and density blobs of the surface, found without rendering and without any model.

Works on a *levelled* cloud: metres (by the unit given) and z against gravity. Everything that follows is a function of
that cloud alone, so the same place gives the same landmarks whatever frame and unit its capture came in.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter

_SIGMA_CELLS = 1.6  # blob scale in cells of its octave's grid
_SURROUND = 1.8  # scale of the surround relative to the blob's
_HALO_CELLS = 12  # reach of the surround's kernel and of the maxima
_BLOCK_CELLS = 192  # grids larger than this are worked through in blocks: memory stays bounded
_WINDOW = np.stack(np.meshgrid(*[np.arange(-2, 3)] * 3, indexing="ij"), -1).reshape(-1, 3)  # 1.2 sigma


@dataclass(frozen=True)
class Params:
    """How landmarks are found; lengths are metres under the layer's unit.

    Args:
        cell_m: grid of the finest octave; its blobs have a scale of 1.6 cells.
        octaves: number of scales, doubling; those finer than the capture's Gaussians are skipped.
        max_spacing_cells: an octave is skipped where points are typically farther from their 8th neighbour than this.
        lab_threshold: smallest colour contrast in a and b, L*a*b* units.
        lightness_factor: the threshold in L is this many times as much.
        density_threshold: smallest excess of surface over a plane's.
        max_per_octave: the strongest are kept.
    """

    cell_m: float = 0.025
    octaves: int = 4
    max_spacing_cells: float = 1.4
    lab_threshold: float = 2.0
    lightness_factor: float = 1.3
    density_threshold: float = 0.6
    max_per_octave: int = 1500


@dataclass(frozen=True, eq=False)
class Blobs:
    """M blobs in the levelled frame, the strongest first.

    Args:
        positions: (M, 3) metres.
        types: (M,) int ``(channel * 2 + negative) * octaves + octave`` with channels L, a, b, density.
        responses: (M,) multiples of the channel's threshold.
        sigmas_m: (M,) blob scale.
    """

    positions: np.ndarray
    types: np.ndarray
    responses: np.ndarray
    sigmas_m: np.ndarray

    def __len__(self) -> int:
        return len(self.positions)


def find_blobs(points: np.ndarray, lab: np.ndarray, areas: np.ndarray, params: Params | None = None) -> Blobs:
    """Extrema of colour and density against their surround, at 1.6 cells and one scale per octave above.

    Points are spread over the grid with the surface they stand for as weight, so that neither the grid's place nor how
    densely a trainer put its Gaussians matters. Colour at a scale is the normalised Gaussian convolution; the response
    is its difference between scale s and 1.8 s. Density is the surface near a point relative to that of a plane
    (``m sqrt(2 pi) s``): corners, clutter and thin things stand out. A blob's position is the mean of the cells around
    the extremum whose response exceeds 0.6 of the peak's, weighted by it. Octaves finer than the points are skipped.

    Args:
        points, lab, areas: (N, 3), (N, 3), (N,) levelled cloud in metres, its L*a*b*, and square metres.
    """
    params = params or Params()
    lab_threshold, octaves = params.lab_threshold, params.octaves
    spacing_m = np.sqrt(8 / np.pi * np.median(areas))
    thresholds = np.array(
        [params.lightness_factor * lab_threshold, lab_threshold, lab_threshold, params.density_threshold]
    )
    found = [_empty()]
    for octave in range(octaves):
        size_m = params.cell_m * 2**octave
        if spacing_m > params.max_spacing_cells * size_m:
            continue
        parts = [_empty()]
        for channel, negative, cells, ratio in _extrema(points / size_m, lab, areas / size_m**2, thresholds):
            kind = np.full(len(cells), (channel * 2 + negative) * octaves + octave, np.int32)
            parts.append(Blobs(cells * size_m, kind, ratio, np.full(len(cells), _SIGMA_CELLS * size_m)))
        found.append(_strongest(parts, params.max_per_octave))
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
    points: np.ndarray, lab: np.ndarray, areas: np.ndarray, thresholds: np.ndarray
) -> Iterator[tuple[int, int, np.ndarray, np.ndarray]]:
    """Yield (channel, negative, positions (n, 3), responses over threshold (n,)); lengths in cells."""
    blocks = np.unique(np.floor(points / _BLOCK_CELLS).astype(np.int64), axis=0)
    for core in blocks * _BLOCK_CELLS:
        near = ((points >= core - _HALO_CELLS) & (points < core + _BLOCK_CELLS + _HALO_CELLS)).all(1)
        low = np.floor(points[near].min(0)).astype(np.int64) - 3  # room for extrema just off the surface
        shape = tuple(np.floor(points[near].max(0)).astype(np.int64) - low + 4)
        at, share = _corners(points[near] - low, shape)
        share = share * areas[near]
        channels = [np.ones(near.sum()), lab[near, 0] - 50.0, lab[near, 1], lab[near, 2]]
        size = int(np.prod(shape))
        fields = [
            np.bincount(at.ravel(), (share * c).ravel(), size).reshape(shape).astype(np.float32) for c in channels
        ]
        for channel, response in enumerate(_responses(*fields)):
            for negative in (0, 1) if channel < 3 else (0,):
                found, ratio = _maxima(-response if negative else response, thresholds[channel])
                found = found + low + 0.5
                inside = ((found >= core) & (found < core + _BLOCK_CELLS)).all(1)
                yield channel, negative, found[inside], ratio[inside]


def _corners(points: np.ndarray, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Flat indices (8, n) and shares (8, n) of the cells that trilinear splatting spreads points over."""
    base = np.floor(points - 0.5).astype(np.int64)
    t = points - 0.5 - base
    steps = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), -1).reshape(-1, 1, 3)
    at = base + steps
    return (at[..., 0] * shape[1] + at[..., 1]) * shape[2] + at[..., 2], np.where(steps, t, 1 - t).prod(-1)


def _responses(mass: np.ndarray, *colour: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the response of L, a, b and density on a dense block; zero away from the surface."""
    more = _SIGMA_CELLS * np.sqrt(_SURROUND**2 - 1)
    mass_s = _blur(mass, _SIGMA_CELLS)
    planes = mass_s * (np.sqrt(2 * np.pi) * _SIGMA_CELLS)
    surface = planes > 0.3
    mass_wide = _blur(mass_s, more)
    for field in colour:
        colour_s = _blur(field, _SIGMA_CELLS)
        colour_wide = _blur(colour_s, more)
        yield np.where(surface, colour_s / np.maximum(mass_s, 1e-9) - colour_wide / np.maximum(mass_wide, 1e-9), 0)
    yield planes - 1


def _blur(field: np.ndarray, sigma: float) -> np.ndarray:
    for axis in range(3):
        field = gaussian_filter1d(field, sigma, axis=axis, mode="constant", truncate=3.0)
    return field


def _maxima(response: np.ndarray, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    """Sub-cell positions (n, 3) of the maxima above ``threshold`` in a window of 5 cells, and peak / threshold."""
    peak = (response > threshold) & (response == maximum_filter(response, size=5, mode="constant", cval=-np.inf))
    at = np.argwhere(peak)
    if len(at) == 0:
        return np.zeros((0, 3)), np.zeros(0)
    around = np.clip(at[:, None] + _WINDOW, 0, np.array(response.shape) - 1)
    values = response[tuple(np.moveaxis(around, -1, 0))]
    top = response[tuple(at.T)]
    weights = np.where(values > 0.6 * top[:, None], values, 0)
    return np.einsum("nk,nkd->nd", weights, around) / weights.sum(1)[:, None], top / threshold

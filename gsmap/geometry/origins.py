"""Choose origins for positions that float32 cannot represent, such as coordinates of a national grid."""

from __future__ import annotations

import numpy as np

from gsmap.geometry.neighbours import neighbours_of
from gsmap.types import GaussianSource
from gsmap.types.source import gathered

_FAR, _LEAST_EXTENT = 16.0, 512.0  # from 8192 units on float32 loses half a thousandth of a unit
_ROUND = 100.0
_SAMPLE = 20_000
_QUERIES = 2_000


def origin_of(positions: np.ndarray) -> np.ndarray:
    """Return the (3,) float64 origin for positions (N, 3).

    The origin is zero if float32 loses less than half a thousandth of a unit or a millionth of the extent; otherwise it
    is the centre, rounded to hundreds, which float32 represents exactly.
    """
    found = positions[:: max(1, len(positions) // _SAMPLE)]
    found = found[np.isfinite(found).all(1)].astype(np.float64)
    if not len(found):
        return np.zeros(3)
    low, high = np.percentile(found, [5, 95], axis=0)
    middle = (low + high) / 2
    if np.abs(middle).max() < _FAR * max(_LEAST_EXTENT, float(np.linalg.norm(high - low))):
        return np.zeros(3)
    out: np.ndarray = np.round(middle / _ROUND) * _ROUND
    return out


def centred(positions: np.ndarray, origin: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (N, 3) as float32 relative to an origin (3,), and the origin; it is `origin_of` the positions by
    default."""
    origin = origin_of(positions) if origin is None else origin
    with np.errstate(over="ignore"):  # a double beyond the range of float32 becomes inf, which validation reports
        return (positions - origin).astype(np.float32), origin


def float32_step(positions: np.ndarray) -> float:
    """Return the spacing of float32 numbers at the farthest of positions (N, 3) float64."""
    found = np.abs(positions[np.isfinite(positions).all(1)]).max(initial=0.0)
    return float(np.spacing(np.float32(found)))


def is_float32(positions: np.ndarray) -> bool:
    """Return whether float32 represents all positions (N, 3) float64 exactly, that is, whether they were rounded to
    float32 before."""
    found = positions[np.isfinite(positions).all(1)]
    return bool((found == found.astype(np.float32)).all())


def neighbour_distance(source: GaussianSource) -> float:
    """Return the median distance from a Gaussian to its nearest neighbour; infinite for a single Gaussian.

    The median is over a sample; one chunk of the source is in memory at a time.
    """
    n = source.num_gaussians
    rows = np.unique(np.linspace(0, n - 1, min(n, _QUERIES)).astype(np.int64))
    at = gathered(source, "means", rows)
    nearest = np.full(len(rows), np.inf)
    start = 0
    for means in source.columns("means"):
        inside = np.isfinite(means).all(1)
        points, k = np.where(inside[:, None], means, np.float32(3e38)), min(2, len(means))
        apart = neighbours_of(points, at, k)[0].reshape(len(at), k)
        own = (rows >= start) & (rows < start + len(means))  # the nearest point of such a row is itself
        nearest = np.minimum(nearest, np.where(own, apart[:, 1] if k > 1 else np.inf, apart[:, 0]))
        start += len(means)
    return float(np.median(nearest))

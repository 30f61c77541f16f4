"""Estimate the similarity of two segments from their size, shape, colour and height above the floor.

Embeddings are not used, so the result does not depend on the embedder. Each of ten differences between two segments
adds log-odds by a decreasing piecewise linear curve (an additive model, as in `gsmap.register.probability`).
``tools/fit/find.py`` fits the curves on synthetic places; they are stored beside this file.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files

import numpy as np

from gsmap.geometry.directions import level_frame
from gsmap.types import Segments

_FILE = "similarity.json"
_MIN_SIZE_M = 0.04  # half a cell of a segment's samples
_HEIGHT_BINS_M = np.linspace(0.0, 2.4, 13)
_LOG_DISTANCE_BINS = np.log(np.geomspace(0.1, 3.2, 11))
_MAX_PAIRS = 4000  # of samples whose distances are measured; with more, no bin changes by a percent
_NUM_HUES, _GREY_CHROMA = 12, 8.0
_NUM_TINTS, _MAX_CHROMA = 12, 60.0

DIFFERENCES = (
    "height",
    "length",
    "width",
    "profile",
    "distances",
    "hue",
    "tints",
    "lightness",
    "contrast",
    "stands",
)
"""Differences between two segments, each 0 for equal segments; the names are also keys of the model file."""


@dataclass(frozen=True, eq=False)
class SegmentDescriptor:
    """Geometry and colour of a segment.

    Args:
        log_sizes: (3,) natural logarithms of the height, and of the length and width along the floor, in metres.
        height_histogram: (13,) histogram over heights above the lowest point.
        distance_histogram: (11,) histogram over log distances of pairs of samples, in metres (D2, Osada et al. 2002).
        hue_histogram: (13,) histogram over hues, and grey.
        tint_histogram: (144,) histogram over a* and b*, from -60 to 60.
        lightness: mean CIE L*.
        colour_range: (3,) difference between the 90th and the 10th percentile of L*, a* and b*.
        elevation_m: height of the lowest point above the floor of the capture.
    """

    log_sizes: np.ndarray
    height_histogram: np.ndarray
    distance_histogram: np.ndarray
    hue_histogram: np.ndarray
    tint_histogram: np.ndarray
    lightness: float
    colour_range: np.ndarray
    elevation_m: float


def describe_segments(segments: Segments, up: np.ndarray) -> list[SegmentDescriptor]:
    """Describe the segments of a capture.

    Args:
        up: (3,) direction against gravity, in the frame of the segments.
    """
    points = segments.samples @ level_frame(up).T * segments.unit_m
    ends = np.cumsum(segments.sample_counts)
    floor = float(np.percentile(points[:, 2], 1)) if len(points) else 0.0
    return [
        describe_samples(points[end - count : end], segments.sample_colours[end - count : end], floor)
        for end, count in zip(ends, segments.sample_counts, strict=True)
    ]


def describe_samples(points: np.ndarray, lab: np.ndarray, floor_m: float) -> SegmentDescriptor:
    """Describe a segment by samples (K, 3) in metres, z up, with CIE Lab colours (K, 3); ``floor_m`` is the height of
    the floor."""
    lab = lab.astype(np.float64)
    foot = float(_percentiles(points[:, 2], 2)[0])
    height = points[:, 2] - foot
    top = float(_percentiles(height, 98)[0])
    flat = points[:, :2] - points[:, :2].mean(0)
    axes = np.linalg.eigh(flat.T @ flat)[1][:, ::-1]
    along = flat @ axes
    low, high = _percentiles(along, 2, 98)
    length, width = high - low
    sizes = np.log([max(v, _MIN_SIZE_M) for v in (top, length, width)])
    return SegmentDescriptor(
        sizes,
        _histogram(height, _HEIGHT_BINS_M),
        _histogram(np.log(np.maximum(_pair_distances(points), 1e-3)), _LOG_DISTANCE_BINS),
        _hue_histogram(lab),
        _tint_histogram(lab),
        float(lab[:, 0].mean()),
        np.ptp(_percentiles(lab, 10, 90), axis=0),
        max(0.0, foot - floor_m),
    )


def _percentiles(values: np.ndarray, *percents: float) -> np.ndarray:
    """Return percentiles of values (K, ...) along their first axis; `numpy.percentile` takes ten times as long for few
    values."""
    ordered = np.sort(values, axis=0)
    at = np.array(percents, np.float64) / 100 * (len(values) - 1)
    low = at.astype(int)
    share = (at - low).reshape(-1, *[1] * (values.ndim - 1))
    below, above = ordered[low], ordered[np.minimum(low + 1, len(values) - 1)]
    out: np.ndarray = np.where(share < 0.5, below + (above - below) * share, above - (above - below) * (1 - share))
    return out


def differences(a: SegmentDescriptor, others: Sequence[SegmentDescriptor]) -> np.ndarray:
    """Return the (N, 10) `DIFFERENCES` between a segment and each of N others."""
    if not others:
        return np.zeros((0, len(DIFFERENCES)))

    def of(name: str) -> np.ndarray:
        return np.abs(np.array([getattr(b, name) for b in others]) - getattr(a, name))

    return np.column_stack(
        [
            of("log_sizes"),
            _histogram_distance(a.height_histogram, np.array([b.height_histogram for b in others])),
            _histogram_distance(a.distance_histogram, np.array([b.distance_histogram for b in others])),
            1.0 - np.sqrt(a.hue_histogram * np.array([b.hue_histogram for b in others])).sum(1),
            1.0 - np.sqrt(a.tint_histogram * np.array([b.tint_histogram for b in others])).sum(1),
            of("lightness"),
            of("colour_range").mean(1),
            np.minimum(of("elevation_m"), 3.0),
        ]
    )


def _histogram_distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the earth mover's distances between histograms, in units of bins."""
    out: np.ndarray = np.abs(np.cumsum(a) - np.cumsum(b, axis=1)).sum(1)
    return out


def _pair_distances(points: np.ndarray) -> np.ndarray:
    """Return the distances of all pairs of points, or of evenly spaced pairs if there are too many."""
    count = len(points)
    if count < 2:
        return np.zeros(1)
    total = count * (count - 1) // 2
    chosen = np.arange(total) if total <= _MAX_PAIRS else np.linspace(0, total - 1, _MAX_PAIRS).astype(np.int64)
    # Compute row i and column j of the k-th pair (i < j), counted row by row.
    i = (count - 2 - np.floor(np.sqrt(4.0 * count * (count - 1) - 8.0 * chosen - 7) / 2 - 0.5)).astype(np.int64)
    j = chosen + i + 1 - total + (count - i) * (count - i - 1) // 2
    out: np.ndarray = np.linalg.norm(points[i] - points[j], axis=1)
    return out


def _histogram(values: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Return a normalized histogram over evenly spaced centres, with linear interpolation."""
    at = np.clip((values - centres[0]) / (centres[1] - centres[0]), 0, len(centres) - 1)
    low = np.minimum(at.astype(int), len(centres) - 2)
    share = at - low
    out = np.bincount(low, 1 - share, len(centres)) + np.bincount(low + 1, share, len(centres))
    return out / max(len(values), 1)


def _hue_histogram(lab: np.ndarray) -> np.ndarray:
    """Return the (13,) shares of 12 hues and of grey."""
    chroma = np.hypot(lab[:, 1], lab[:, 2])
    coloured = chroma / (chroma + _GREY_CHROMA)
    at = np.arctan2(lab[:, 2], lab[:, 1]) / (2 * np.pi) * _NUM_HUES % _NUM_HUES
    low, share = at.astype(int) % _NUM_HUES, at - np.floor(at)
    out = np.bincount(low, coloured * (1 - share), _NUM_HUES) + np.bincount(
        (low + 1) % _NUM_HUES, coloured * share, _NUM_HUES
    )
    return np.append(out, (1 - coloured).sum()) / max(len(lab), 1)


def _tint_histogram(lab: np.ndarray) -> np.ndarray:
    """Return the (144,) shares of 12 x 12 tints, interpolated and blurred."""
    out = np.zeros((_NUM_TINTS, _NUM_TINTS))
    at = np.clip((lab[:, 1:] + _MAX_CHROMA) / (2 * _MAX_CHROMA) * _NUM_TINTS - 0.5, 0, _NUM_TINTS - 1 - 1e-9)
    low, share = at.astype(int), at - np.floor(at)
    for i in (0, 1):
        for j in (0, 1):
            weight = np.abs(1 - i - share[:, 0]) * np.abs(1 - j - share[:, 1])
            np.add.at(out, (low[:, 0] + i, low[:, 1] + j), weight)
    for axis in (0, 1):
        padded = np.pad(out, 1, mode="edge").take(range(1, _NUM_TINTS + 1), axis=1 - axis)
        out = padded.take(range(_NUM_TINTS), axis) + 2 * out + padded.take(range(2, _NUM_TINTS + 2), axis)
    flat: np.ndarray = out.ravel() / out.sum()
    return flat


@dataclass(frozen=True)
class SimilarityModel:
    """Log-odds of each difference.

    Args:
        knots: knots for each of `DIFFERENCES`, ascending from 0.
        worth: log-odds at each knot, descending from 0; linear between knots, constant beyond the last.
        base: log-odds of two segments without any difference.
    """

    knots: tuple[tuple[float, ...], ...]
    worth: tuple[tuple[float, ...], ...]
    base: float

    @classmethod
    def load(cls) -> SimilarityModel:
        """Load the model of this package."""
        return _load()

    def log_odds(self, differing: np.ndarray) -> np.ndarray:
        """Return the (N,) log-odds, from `differences` (N, 10), that two segments are of the same kind."""
        columns = zip(differing.T, self.knots, self.worth, strict=True)
        return self.base + sum((np.interp(*column) for column in columns), np.zeros(len(differing)))


@lru_cache(maxsize=1)
def _load() -> SimilarityModel:
    stored = json.loads((files("gsmap.find") / _FILE).read_text())
    curves = [stored["curves"][name] for name in DIFFERENCES]
    return SimilarityModel(
        tuple(tuple(curve["knots"]) for curve in curves),
        tuple(tuple(curve["worth"]) for curve in curves),
        float(stored["base"]),
    )

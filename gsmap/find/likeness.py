"""How alike two things are, of what graphs hold of them: size, shape and colour, and where they stand.

No embedding takes part, so it is the same whichever embedder a map has. Ten differences of two things are each worth
so much against their being of one kind, by a piecewise linear curve that only falls, and the worths are added: an
additive model over log-odds, as `gsmap.register.probability` is one. The curves are fitted by ``tools/fit/find.py`` on
made places, and stored beside this file.
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

_FILE = "likeness.json"
_LEAST_M = 0.04  # half a cell of a thing's samples: nothing is told to be thinner
_HEIGHTS_M = np.linspace(0.0, 2.4, 13)
_DISTANCES = np.log(np.geomspace(0.1, 3.2, 11))
_PAIRS = 4000  # of samples whose distances are looked at: more change no bin by a percent
_HUES, _GREY = 12, 8.0
_TINTS, _REACH = 12, 60.0

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
"""What two things are compared by, each a number that is 0 for equal ones."""


@dataclass(frozen=True, eq=False)
class Look:
    """What is compared of a thing.

    Args:
        sizes: (3,) natural logarithms of its height, and of its length and width along the floor, metres.
        profile: (13,) how much of it lies at each height above its foot.
        distances: (11,) how far its parts lie from each other (Osada et al. 2002, D2), over log metres.
        hue: (13,) how much of it is of each hue, and grey.
        tints: (144,) how much of it is of each a* and b*, from -60 to 60.
        lightness: mean, CIE L*.
        contrast: (3,) from the tenth to the ninetieth of a hundred, L*, a* and b*.
        stands: how far its foot stands above the lowest thing of the capture, metres.
    """

    sizes: np.ndarray
    profile: np.ndarray
    distances: np.ndarray
    hue: np.ndarray
    tints: np.ndarray
    lightness: float
    contrast: np.ndarray
    stands: float


def looks_of(things: Segments, up: np.ndarray) -> list[Look]:
    """What is compared of each of the things of a capture.

    Args:
        up: (3,) against gravity, the frame of the things.
    """
    points = things.samples @ level_frame(up).T * things.unit_m
    ends = np.cumsum(things.sample_counts)
    floor = float(np.percentile(points[:, 2], 1)) if len(points) else 0.0
    return [
        look_of(points[end - count : end], things.sample_colours[end - count : end], floor)
        for end, count in zip(ends, things.sample_counts, strict=True)
    ]


def look_of(points: np.ndarray, lab: np.ndarray, floor_m: float) -> Look:
    """Of samples (K, 3), metres, z up, with their colours (K, 3); ``floor_m`` is the height of the floor."""
    lab = lab.astype(np.float64)
    foot = float(np.percentile(points[:, 2], 2))
    height = points[:, 2] - foot
    top = float(np.percentile(height, 98))
    flat = points[:, :2] - points[:, :2].mean(0)
    axes = np.linalg.eigh(flat.T @ flat)[1][:, ::-1]
    along = flat @ axes
    length, width = np.percentile(along, 98, axis=0) - np.percentile(along, 2, axis=0)
    sizes = np.log([max(v, _LEAST_M) for v in (top, length, width)])
    return Look(
        sizes,
        _histogram(height, _HEIGHTS_M),
        _histogram(np.log(np.maximum(_distances(points), 1e-3)), _DISTANCES),
        _hues(lab),
        _tints(lab),
        float(lab[:, 0].mean()),
        np.ptp(np.percentile(lab, [10, 90], axis=0), axis=0),
        max(0.0, foot - floor_m),
    )


def differences(a: Look, others: Sequence[Look]) -> np.ndarray:
    """(N, 10) how a thing differs from each of others, by `DIFFERENCES`."""
    if not others:
        return np.zeros((0, len(DIFFERENCES)))

    def of(name: str) -> np.ndarray:
        return np.abs(np.array([getattr(b, name) for b in others]) - getattr(a, name))

    return np.column_stack(
        [
            of("sizes"),
            _apart(a.profile, np.array([b.profile for b in others])),
            _apart(a.distances, np.array([b.distances for b in others])),
            1.0 - np.sqrt(a.hue * np.array([b.hue for b in others])).sum(1),
            1.0 - np.sqrt(a.tints * np.array([b.tints for b in others])).sum(1),
            of("lightness"),
            of("contrast").mean(1),
            np.minimum(of("stands"), 3.0),
        ]
    )


def _apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Half the sum of the differences of cumulated histograms: by how many bins one has to be moved to be the other."""
    out: np.ndarray = np.abs(np.cumsum(a) - np.cumsum(b, axis=1)).sum(1)
    return out


def _distances(points: np.ndarray) -> np.ndarray:
    """Of pairs of the points, all or an even share: the same for the same points."""
    count = len(points)
    if count < 2:
        return np.zeros(1)
    total = count * (count - 1) // 2
    chosen = np.arange(total) if total <= _PAIRS else np.linspace(0, total - 1, _PAIRS).astype(np.int64)
    # The k-th pair (i < j) of all, counted row by row.
    i = (count - 2 - np.floor(np.sqrt(4.0 * count * (count - 1) - 8.0 * chosen - 7) / 2 - 0.5)).astype(np.int64)
    j = chosen + i + 1 - total + (count - i) * (count - i - 1) // 2
    out: np.ndarray = np.linalg.norm(points[i] - points[j], axis=1)
    return out


def _histogram(values: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Shares of values over evenly spaced centres, each value shared by its two neighbours."""
    at = np.clip((values - centres[0]) / (centres[1] - centres[0]), 0, len(centres) - 1)
    low = np.minimum(at.astype(int), len(centres) - 2)
    share = at - low
    out = np.bincount(low, 1 - share, len(centres)) + np.bincount(low + 1, share, len(centres))
    return out / max(len(values), 1)


def _hues(lab: np.ndarray) -> np.ndarray:
    """(13,) shares of 12 hues and of grey."""
    chroma = np.hypot(lab[:, 1], lab[:, 2])
    coloured = chroma / (chroma + _GREY)
    at = np.arctan2(lab[:, 2], lab[:, 1]) / (2 * np.pi) * _HUES % _HUES
    low, share = at.astype(int) % _HUES, at - np.floor(at)
    out = np.bincount(low, coloured * (1 - share), _HUES) + np.bincount((low + 1) % _HUES, coloured * share, _HUES)
    return np.append(out, (1 - coloured).sum()) / max(len(lab), 1)


def _tints(lab: np.ndarray) -> np.ndarray:
    """(144,) shares of 12 x 12 tints, each colour shared by the four nearest and these by their neighbours."""
    out = np.zeros((_TINTS, _TINTS))
    at = np.clip((lab[:, 1:] + _REACH) / (2 * _REACH) * _TINTS - 0.5, 0, _TINTS - 1 - 1e-9)
    low, share = at.astype(int), at - np.floor(at)
    for i in (0, 1):
        for j in (0, 1):
            weight = np.abs(1 - i - share[:, 0]) * np.abs(1 - j - share[:, 1])
            np.add.at(out, (low[:, 0] + i, low[:, 1] + j), weight)
    for axis in (0, 1):
        padded = np.pad(out, 1, mode="edge").take(range(1, _TINTS + 1), axis=1 - axis)
        out = padded.take(range(_TINTS), axis) + 2 * out + padded.take(range(2, _TINTS + 2), axis)
    flat: np.ndarray = out.ravel() / out.sum()
    return flat


@dataclass(frozen=True)
class Model:
    """What each difference is worth.

    Args:
        knots: of each of `DIFFERENCES`, rising from 0.
        worth: log-odds at each knot, falling from 0; straight between, constant beyond.
        base: log-odds of two things without any difference.
    """

    knots: tuple[tuple[float, ...], ...]
    worth: tuple[tuple[float, ...], ...]
    base: float

    @classmethod
    def load(cls) -> Model:
        """The model that gsmap comes with."""
        return _shipped()

    def log_odds(self, differing: np.ndarray) -> np.ndarray:
        """(N,) of `differences` (N, 10): that two things are of one kind."""
        columns = zip(differing.T, self.knots, self.worth, strict=True)
        return self.base + sum((np.interp(*column) for column in columns), np.zeros(len(differing)))


@lru_cache(maxsize=1)
def _shipped() -> Model:
    stored = json.loads((files("gsmap.find") / _FILE).read_text())
    curves = [stored["curves"][name] for name in DIFFERENCES]
    return Model(
        tuple(tuple(curve["knots"]) for curve in curves),
        tuple(tuple(curve["worth"]) for curve in curves),
        float(stored["base"]),
    )

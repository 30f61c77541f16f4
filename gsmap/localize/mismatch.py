"""Compute the mismatch map: the probability, for each cell of a photo, that the photo shows something other than a
render.

An aliased room has the same walls, but other furniture and pictures in front of them. The correct room differs in at
most one part (an open door, a person) and agrees in the rest. A small network classifies each cell, because a render
that is blurred where cameras saw little may still show the same content. ``tools/fit/localize.py`` fits it on synthetic
places with known changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files

import numpy as np
from scipy.ndimage import binary_dilation, label

from gsmap.compare.colours import balance
from gsmap.geometry.filters import blur, box_means
from gsmap.localize.candidate_renders import GREY, SceneRender, downsample, downsample_mask
from gsmap.localize.distances import relative_distance

MISMATCH_PROBABILITY = 0.5
"""A cell with at least this probability counts as a mismatch."""

STEP, SIDE = 4, 9
"""Spacing and width of cells, in pixels of the photo at half size; the network is valid for these values only."""

STEP_PX = 2 * STEP
"""Spacing of cells, in pixels of the photo."""

_FILE = "mismatch.npz"
# The network is valid for these values only.
_WIDE = 17  # pixels at half size
_LIGHT_CELLS = 5.0  # standard deviation of the blur that estimates light, in cells
_COLOUR_STRIDE = 5  # spacing of the pixels to which the colour balance is fitted
_OPAQUE = 0.9
_CLIPPED = 0.98  # brighter colours of the photo are overexposed
_MIN_VALID = 0.6  # share of a cell that must be opaque and not overexposed
_MIN_VALUE = 1e-3  # lower limit of values in logarithms
_MAX_DEVIATIONS = 6.0


@dataclass(frozen=True, eq=False)
class MismatchMap:
    """The probability, for each cell of a photo, that the photo shows something other than the map.

    Args:
        probability: (R, C) for the scene that matches best; NaN where no scene is rendered. Cells are `STEP_PX` pixels
            of the photo apart; the first cell is at the photo's corner.
        part: (R, C) mask of the largest connected mismatch: one object may have changed, or a person may hide it.
    """

    probability: np.ndarray
    part: np.ndarray

    @classmethod
    def from_probability(cls, probability: np.ndarray) -> MismatchMap:
        """Label the largest connected part whose probability exceeds `MISMATCH_PROBABILITY`."""
        labels, count = label(np.nan_to_num(probability) > MISMATCH_PROBABILITY)
        sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:]
        return cls(probability, labels == 1 + sizes.argmax() if count else np.zeros(probability.shape, bool))

    def part_share(self) -> float:
        """Return the share of the compared cells that is in the largest part; NaN without cells."""
        known = np.isfinite(self.probability)
        return float(self.part.sum() / known.sum()) if known.any() else float("nan")

    def mean_outside(self) -> float:
        """Return the mean probability outside the largest part; NaN without cells."""
        rest = self.probability[np.isfinite(self.probability) & ~binary_dilation(self.part)]
        return float(rest.mean()) if len(rest) else float("nan")

    def share_outside(self, min_probability: float) -> float:
        """Return the share of the compared cells that is outside the largest part and above a probability; NaN without
        cells."""
        known = np.isfinite(self.probability)
        if not known.any():
            return float("nan")
        return float(((np.nan_to_num(self.probability) > min_probability) & ~self.part).sum() / known.sum())

    def covers(self, shape: tuple[int, ...], first_px: int, step_px: int) -> np.ndarray:
        """Return an (R, C) mask of patches that the largest part, dilated by a cell, covers.

        Args:
            shape: number of rows and columns of patches.
        first_px, step_px: distance of the first patch from the photo's corner, and spacing of the patches.
        """
        wide = binary_dilation(self.part)
        rows, columns = (
            np.minimum((first_px + step_px * np.arange(n)) // STEP_PX, m - 1)
            for n, m in zip(shape, wide.shape, strict=True)
        )
        return wide[np.ix_(rows, columns)]


@lru_cache(maxsize=1)
def load_network() -> tuple[np.ndarray, ...]:
    """Load the network of this package: mean and spread of the features, then the weights and offsets of each layer."""
    with np.load(str(files("gsmap.localize") / _FILE)) as stored:
        return tuple(stored[name].astype(np.float32) for name in stored.files)


def mismatch_map(rgb: np.ndarray, renders: Sequence[SceneRender], mask: np.ndarray | None = None) -> MismatchMap:
    """Compare a photo (H, W, 3), float32 in [0, 1], with renders of the same size from the photo's pose.

    Args:
        mask: (H, W) mask of valid pixels of the photo; None if all are valid.
    """
    half, half_mask = downsample(rgb, 2), downsample_mask(mask, 2)
    least: np.ndarray | None = None
    for one in renders:
        features, valid = cell_features(half, one, half_mask)
        found = np.where(valid, classify(features), np.inf)
        least = found if least is None else np.minimum(least, found)
    if least is None:
        least = np.full((1, 1), np.inf)
    return MismatchMap.from_probability(np.where(np.isfinite(least), least, np.nan))


def classify(features: np.ndarray) -> np.ndarray:
    """Return the (R, C) mismatch probabilities of features (R, C, F)."""
    mean, spread, *layers = load_network()
    x = normalize(features, mean, spread)
    for weights, offsets in zip(layers[:-2:2], layers[1:-2:2], strict=True):
        x = np.tanh(x @ weights + offsets)
    out: np.ndarray = 1 / (1 + np.exp(-(x @ layers[-2] + layers[-1])[..., 0]))
    return out


def normalize(features: np.ndarray, mean: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Normalize features for the network, and clip outliers."""
    out: np.ndarray = np.clip((features - mean) / spread, -_MAX_DEVIATIONS, _MAX_DEVIATIONS)
    return out


def cell_features(half: np.ndarray, one: SceneRender, mask: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Compute the features (R, C, F), float32, of the cells of a photo at half size and of a full-size render; also
    return validity.

    Args:
        mask: (H, W) mask of valid pixels of the photo at half size; None if all are valid.
    """
    rendered = downsample(one.rgb, 2)
    valid = (downsample(one.alpha, 2) > _OPAQUE) & (half.max(2) < _CLIPPED)
    if mask is not None:
        valid &= mask
    a, b = half @ GREY, rendered @ GREY
    hue, light, spreads = _colour_differences(half, rendered, valid)
    depth = downsample(one.depth_m, 2)[::STEP, ::STEP]
    fine = [(x - blur(x, 1.0)) ** 2 for x in (a, b)]
    patterns = [a, b, a * a, b * b, a * b]
    planes = [valid, downsample(one.smooth, 2), hue, light, np.abs(light), *fine]
    near = box_means(np.stack([*patterns, *planes], axis=2), SIDE, step=STEP)
    wide = box_means(np.stack(patterns, axis=2), _WIDE, step=STEP)
    share, smooth, hue, light, lightness, fine_a, fine_b = np.moveaxis(near[..., 5:], 2, 0)
    hue, light, lightness = (x / np.maximum(share, _MIN_VALUE) for x in (hue, light, lightness))
    field = blur(light * share, _LIGHT_CELLS) / np.maximum(blur(share, _LIGHT_CELLS), _MIN_VALUE)
    columns = [
        *_correlation(near),
        *_correlation(wide),
        np.minimum(hue, 2),
        np.clip(light - field, -2, 2),
        np.minimum(lightness, 2),
        share,
        smooth,
        *(_log(np.sqrt(x)) for x in (fine_a, fine_b)),
        np.log(np.clip(depth / relative_distance(depth), 0.1, 20)),
        *(_log(np.full_like(share, spread)) for spread in spreads),
    ]
    valid_cells = share > _MIN_VALID
    if mask is not None:  # masked pixels must not reach into the wide patterns
        valid_cells &= box_means(mask.astype(np.float32), _WIDE, step=STEP) > 0.95
    return np.stack(columns, axis=2), valid_cells


def _correlation(found: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the correlation of two patterns and the log contrast of each, from the means of values, squares and
    products."""
    a, b, square_a, square_b, product = np.moveaxis(found[..., :5], 2, 0)
    var_a, var_b = np.maximum(square_a - a**2, 0), np.maximum(square_b - b**2, 0)
    correlation = (product - a * b) / np.sqrt(np.maximum(var_a * var_b, 1e-10))
    return correlation, _log(np.sqrt(var_a)), _log(np.sqrt(var_b))


def _colour_differences(
    half: np.ndarray, rendered: np.ndarray, valid: np.ndarray
) -> tuple[np.ndarray, np.ndarray, tuple[float, float]]:
    """Return differences of hue and of lightness after colour balance (0 where invalid), and the residual spreads of
    the balance."""
    line = balance(rendered[valid][::_COLOUR_STRIDE], half[valid][::_COLOUR_STRIDE])
    chroma, light = line.differences(rendered, half, valid)
    hue, light = (np.where(valid, plane, np.float32(0)) for plane in (np.abs(chroma).max(2), light))
    return hue, light, (line.chroma_spread, line.lightness_spread)


def _log(values: np.ndarray) -> np.ndarray:
    out: np.ndarray = np.log10(np.maximum(values, _MIN_VALUE), dtype=np.float32)
    return out

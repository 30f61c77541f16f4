"""Which parts of a photograph show something else than a render from its pose, and how much of it that is.

A room that looks like another one has its walls and its pictures and other furniture before them; the room itself, its
doors open, or with somebody in it, differs in one part and agrees in the rest. So it is asked cell by cell, by a small
network that ``tools/fit/localize.py`` fits on made places, where it is known what differs: a render is blurred where
cameras saw little, and shows the same all the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files

import numpy as np
from scipy.ndimage import binary_dilation, label

from gsmap.compare.colours import balance
from gsmap.localize.filters import blurred, means
from gsmap.localize.looks import GREY, Look, smaller, wholly

_FILE = "unlike.npz"
# What the network was fitted with: it means nothing with other values, so none of these is a setting.
STEP, SIDE, _WIDE = 4, 9, 17  # pixels, at half the size of the picture
EVERY_PX = 2 * STEP
_LIGHT = 5.0  # cells over which light changes (standard deviation of a Gaussian)
_EVERY = 5  # of the pixels so many are asked for the light
_OPAQUE = 0.9
_CLIPPED = 0.98  # colours of the photo from which on they tell nothing
_KNOWN = 0.6  # of a cell must be opaque, and not clipped
_LEAST = 1e-3  # of what a logarithm is taken
_FAR = 6.0  # standard deviations


@dataclass(frozen=True, eq=False)
class Unlike:
    """How probable it is, cell by cell, that a photograph shows something else than the map.

    Args:
        probability: (R, C) of the scene that is most like it; NaN where none shows anything. Cells lie `EVERY_PX`
            pixels of the photo apart, the first one at its corner.
        part: (R, C) bool: the largest connected part of it that is likely something else: one thing may have come or
            gone, a door be open, or somebody stand there.
    """

    probability: np.ndarray
    part: np.ndarray

    @classmethod
    def of(cls, probability: np.ndarray, likely: float) -> Unlike:
        """With the part that is something else by so high a probability."""
        labels, count = label(np.nan_to_num(probability) > likely)
        sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:]
        return cls(probability, labels == 1 + sizes.argmax() if count else np.zeros(probability.shape, bool))

    def in_part(self) -> float:
        """Share of what can be compared that the part has; NaN of nothing."""
        known = np.isfinite(self.probability)
        return float(self.part.sum() / known.sum()) if known.any() else float("nan")

    def outside(self) -> float:
        """Of what lies outside, the share that is expected to be something else; NaN of nothing."""
        rest = self.probability[np.isfinite(self.probability) & ~binary_dilation(self.part)]
        return float(rest.mean()) if len(rest) else float("nan")

    def surely_outside(self, bar: float) -> float:
        """Share of what can be compared that lies outside and is something else by this probability; NaN of nothing."""
        known = np.isfinite(self.probability)
        if not known.any():
            return float("nan")
        return float(((np.nan_to_num(self.probability) > bar) & ~self.part).sum() / known.sum())

    def covers(self, shape: tuple[int, ...], first_px: int, step_px: int) -> np.ndarray:
        """(R, C) bool of patches, the first of which lies so many pixels from the photo's corner, whether the part (and
        a cell around it) covers them."""
        wide = binary_dilation(self.part)
        rows, columns = (
            np.minimum((first_px + step_px * np.arange(n)) // EVERY_PX, m - 1)
            for n, m in zip(shape, wide.shape, strict=True)
        )
        return wide[np.ix_(rows, columns)]


@lru_cache(maxsize=1)
def network() -> tuple[np.ndarray, ...]:
    """What gsmap comes with: mean and spread of the features, then weights and offsets of each layer."""
    with np.load(str(files("gsmap.localize") / _FILE)) as held:
        return tuple(held[name].astype(np.float32) for name in held.files)


def unlike(rgb: np.ndarray, looks: Sequence[Look], likely: float, known: np.ndarray | None = None) -> Unlike:
    """Compare a photo (H, W, 3) float32 in [0, 1] with renders from its pose, of its size.

    Args:
        likely: of `Unlike.of`.
        known: (H, W) bool: pixels of the photo that count; None of all.
    """
    half, shows = smaller(rgb, 2), wholly(known, 2)
    least: np.ndarray | None = None
    for one in looks:
        features, told = cells(half, one, shows)
        found = np.where(told, probabilities(features), np.inf)
        least = found if least is None else np.minimum(least, found)
    if least is None:
        least = np.full((1, 1), np.inf)
    return Unlike.of(np.where(np.isfinite(least), least, np.nan), likely)


def probabilities(features: np.ndarray) -> np.ndarray:
    """(R, C) of features (R, C, F)."""
    mean, spread, *layers = network()
    x = scaled(features, mean, spread)
    for weights, offsets in zip(layers[:-2:2], layers[1:-2:2], strict=True):
        x = np.tanh(x @ weights + offsets)
    out: np.ndarray = 1 / (1 + np.exp(-(x @ layers[-2] + layers[-1])[..., 0]))
    return out


def scaled(features: np.ndarray, mean: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Features as the network takes them; what is far from all that it has seen is brought nearer."""
    out: np.ndarray = np.clip((features - mean) / spread, -_FAR, _FAR)
    return out


def cells(half: np.ndarray, one: Look, known: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """(R, C, F) float32 of what each cell shows in a photo of half size and in a render of full size, and which (R, C)
    are known; of the photo's pixels all, or those that ``known`` (H, W) says."""
    shown = smaller(one.rgb, 2)
    tells = (smaller(one.alpha, 2) > _OPAQUE) & (half.max(2) < _CLIPPED)
    if known is not None:
        tells &= known
    a, b = half @ GREY, shown @ GREY
    hue, light, spreads = _colours(half, shown, tells)
    fine = [(x - blurred(x, 1.0)) ** 2 for x in (a, b)]
    patterns = [a, b, a * a, b * b, a * b]
    planes = [tells, smaller(one.sound, 2), hue, light, np.abs(light), *fine]
    near = means(np.stack([*patterns, *planes], axis=2), SIDE, step=STEP)
    wide = means(np.stack(patterns, axis=2), _WIDE, step=STEP)
    share, sound, hue, light, lightness, fine_a, fine_b = np.moveaxis(near[..., 5:], 2, 0)
    hue, light, lightness = (x / np.maximum(share, _LEAST) for x in (hue, light, lightness))
    field = blurred(light * share, _LIGHT) / np.maximum(blurred(share, _LIGHT), _LEAST)
    columns = [
        *_alike(near),
        *_alike(wide),
        np.minimum(hue, 2),
        np.clip(light - field, -2, 2),
        np.minimum(lightness, 2),
        share,
        sound,
        *(_log(np.sqrt(x)) for x in (fine_a, fine_b)),
        np.log(np.clip(smaller(one.depth_m, 2)[::STEP, ::STEP], 0.1, 20)),
        *(_log(np.full_like(share, spread)) for spread in spreads),
    ]
    told = share > _KNOWN
    if known is not None:  # nothing of what stands before the place may reach into a pattern
        told &= means(known.astype(np.float32), _WIDE, step=STEP) > 0.95
    return np.stack(columns, axis=2), told


def _alike(found: np.ndarray) -> tuple[np.ndarray, ...]:
    """Correlation of two patterns, and the logarithm of the contrast of each, of means of both, squares and product."""
    a, b, square_a, square_b, product = np.moveaxis(found[..., :5], 2, 0)
    var_a, var_b = np.maximum(square_a - a**2, 0), np.maximum(square_b - b**2, 0)
    correlation = (product - a * b) / np.sqrt(np.maximum(var_a * var_b, 1e-10))
    return correlation, _log(np.sqrt(var_a)), _log(np.sqrt(var_b))


def _colours(
    half: np.ndarray, shown: np.ndarray, tells: np.ndarray
) -> tuple[np.ndarray, np.ndarray, tuple[float, float]]:
    """How far hue and lightness are apart after light is taken out (0 where nothing tells), and what of both no line
    explains."""
    line = balance(shown[tells][::_EVERY], half[tells][::_EVERY])
    chroma, light = line.differences(shown, half, tells)
    hue, light = (np.where(tells, plane, np.float32(0)) for plane in (np.abs(chroma).max(2), light))
    return hue, light, (line.chroma_spread, line.lightness_spread)


def _log(values: np.ndarray) -> np.ndarray:
    out: np.ndarray = np.log10(np.maximum(values, _LEAST), dtype=np.float32)
    return out

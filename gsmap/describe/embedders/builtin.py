"""Embedder without a network: histograms of colour, texture and shape of a mask.

The feature consists of four histograms. Each is the square root of a distribution, so that a dot product is a
Bhattacharyya coefficient:

- *hue*: a*b* direction in 12 soft bins where there is colour, one bin for grey. Gain and gamma hardly change it.
- *lightness*: L* relative to the median of the view, in 7 soft bins: exposure moves both.
- *texture*: strength of the L* gradient relative to L*, in 6 soft bins; without direction, so the camera may roll.
- *shape*: of the surface points in 3D: logarithm of the size (metres by the assumed unit), flatness and elongation
  from the principal axes, and the angle of the flattest axis with gravity; soft bins each.

All are invariant to the camera's position and roll, so that the features of one object agree over views and captures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.geometry.colour import srgb_to_lab
from gsmap.types.views import Mask, SceneContext, View

VERSION = 1
MODELS: tuple[str, ...] = ()
_HUES = 12
_LIGHTNESS = np.linspace(-45, 45, 7)
_TEXTURE = np.linspace(-5, 0, 6)  # natural log of |grad L| / L per pixel
_SIZE = np.log(np.array([0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4]))
_RATIO = np.linspace(0, 1, 5)
# Weights of hue, lightness, texture and shape; their squares are shares of the cosine.
_WEIGHTS = np.array([1.0, 0.7, 0.5, 0.9])
_GREY_CHROMA = 8.0  # a pixel with this chroma (L*a*b* units) counts half as coloured and half as grey
_PARTS = (_HUES + 1, len(_LIGHTNESS), len(_TEXTURE), len(_SIZE) + 3 * len(_RATIO))


@dataclass(frozen=True)
class Params:
    """Settings of the embedder: none, because layers are comparable only under the same weights."""


def make(context: SceneContext, params: Params) -> BuiltinEmbedder:
    """Create an embedder with the scene's vertical and unit; see `gsmap.methods.embedder`."""
    return BuiltinEmbedder(context.up, context.unit_m)


class BuiltinEmbedder:
    """Histograms of appearance and shape."""

    is_thread_safe = True

    def __init__(self, up: np.ndarray | None, unit_m: float) -> None:
        self.weights = np.repeat(_WEIGHTS / np.linalg.norm(_WEIGHTS), _PARTS).astype(np.float32)
        self.up, self.unit_m = up, unit_m

    def embed(self, view: View, masks: Sequence[Mask], points: Sequence[np.ndarray]) -> np.ndarray:
        """Compute features (R, F) of the masks; see `gsmap.methods.embedder`."""
        if not masks:
            return np.zeros((0, sum(_PARTS)), np.float32)
        lab = srgb_to_lab(view.rgb)
        seen = view.alpha > 0.5
        middle = np.median(lab[seen, 0]) if seen.any() else 50.0
        slope = np.hypot(*np.gradient(lab[..., 0])) / np.maximum(lab[..., 0], 5.0)
        rows = []
        # Compute the bins of every pixel once, because there are many masks and they overlap.
        hues = _hues(lab)
        lightness = _soft_bins(lab[..., 0] - middle, _LIGHTNESS)
        texture = _soft_bins(np.log(np.maximum(slope, 1e-4)), _TEXTURE)
        for mask, shown in zip(masks, points, strict=True):
            at = np.flatnonzero(mask.pixels)
            parts = [
                hues.of(at),
                lightness.of(at),
                texture.of(at),
                self._shape(shown),
            ]
            rows.append(np.concatenate([np.sqrt(p / max(p.sum(), 1e-12)) for p in parts]) * self.weights)
        return np.stack(rows).astype(np.float32)

    def embed_picture(self, rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute features of a picture from its colours alone, because size in metres, 3D shape and resolution are
        unknown.

        Args:
            rgb: (H, W, 3) uint8.

        Returns:
            (F,) features, and an (F,) mask of the valid features.
        """
        lab = srgb_to_lab(rgb / 255.0)
        valid = np.repeat([True, False, False, False], _PARTS)
        hue = _hues(lab).of(slice(None))
        out = np.zeros(sum(_PARTS))
        out[: _PARTS[0]] = np.sqrt(hue / max(hue.sum(), 1e-12))
        return (out * self.weights).astype(np.float32), valid

    def _shape(self, points: np.ndarray) -> np.ndarray:
        values, axes = np.linalg.eigh(np.cov((points * self.unit_m).T) + 1e-8 * np.eye(3))
        spread = np.sqrt(values)
        tilt = 0.5 if self.up is None else abs(float(axes[:, 0] @ self.up))
        ratio = _soft_bins(np.array([spread[0] / spread[2], spread[1] / spread[2], tilt]), _RATIO)
        ratios, rows = np.zeros((3, ratio.size)), np.arange(3)
        ratios[rows, ratio.low], ratios[rows, ratio.high] = ratio.low_share, ratio.high_share
        return np.concatenate([_soft_bins(np.log(4 * spread[2:]), _SIZE).of(slice(None)), ratios.ravel()])


@dataclass(frozen=True, eq=False)
class _SoftBins:
    """Soft histogram bins of N values, each shared between two bins.

    Args:
        low, high: (N,) the two bins of each value.
        low_share, high_share: (N,) weights in the two bins.
        size: number of bins.
        rest: (N,) weight in an additional last bin; None without such a bin.
    """

    low: np.ndarray
    high: np.ndarray
    low_share: np.ndarray
    high_share: np.ndarray
    size: int
    rest: np.ndarray | None = None

    def of(self, rows: np.ndarray | slice) -> np.ndarray:
        """Return the histogram of the values at ``rows``."""
        out = np.bincount(self.low[rows], self.low_share[rows], self.size)
        out = out + np.bincount(self.high[rows], self.high_share[rows], self.size)
        return out if self.rest is None else np.concatenate([out, [self.rest[rows].sum()]])


def _soft_bins(values: np.ndarray, centres: np.ndarray) -> _SoftBins:
    """Distribute each value linearly between the two nearest of evenly spaced centres."""
    at = np.clip((values.ravel() - centres[0]) / (centres[1] - centres[0]), 0, len(centres) - 1)
    low = np.minimum(at.astype(int), len(centres) - 2)
    share = at - low
    return _SoftBins(low, low + 1, 1 - share, share, len(centres))


def _hues(lab: np.ndarray) -> _SoftBins:
    """Distribute pixels over bins of the hue circle and one bin for grey, depending on their chroma relative to
    `_GREY_CHROMA`."""
    a, b = lab[..., 1].ravel(), lab[..., 2].ravel()
    chroma = np.hypot(a, b)
    coloured = chroma / (chroma + _GREY_CHROMA)
    at = np.arctan2(b, a) / (2 * np.pi) * _HUES % _HUES
    low = at.astype(int) % _HUES
    share = at - at.astype(int)
    return _SoftBins(low, (low + 1) % _HUES, coloured * (1 - share), coloured * share, _HUES, 1 - coloured)

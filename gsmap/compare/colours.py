"""Colours of two captures, compared after exposure, white balance and the strength of light are taken out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.compare.params import Params

_FLOOR = 0.03  # added before logarithms: what is darker is noise
_SAMPLES = 40_000  # pixels that a line is fitted to
_ROUNDS = 6
_FEWEST = 200  # pixels with which a line is fitted at all


@dataclass(frozen=True, eq=False)
class Balance:
    """How the colours of one capture become those of another: ``log b = slope * log a + offset``, per channel.

    A display colour that was multiplied and raised to a power stays on such a line, so gain, gamma and white balance
    are in it.

    Args:
        slope, offset: (3,) of the line.
        chroma_spread, lightness_spread: robust standard deviation of what is left over where both captures agree.
    """

    slope: np.ndarray
    offset: np.ndarray
    chroma_spread: float
    lightness_spread: float

    def gains(self) -> np.ndarray:
        """(3,) by which a middle grey of the first is multiplied to look like the second's."""
        grey = np.log(0.5)
        out: np.ndarray = np.exp((self.slope - 1) * grey + self.offset)
        return out

    def applied(self, colour: np.ndarray) -> np.ndarray:
        """Colours (..., 3) of the first as the second would show them."""
        logs = np.log(np.clip(colour, 0, 1) + np.float32(_FLOOR))
        out = np.exp(logs * self.slope.astype(np.float32) + self.offset.astype(np.float32)) - np.float32(_FLOOR)
        return np.clip(out, 0, 1).astype(np.float32)

    def differences(self, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far colours (..., 3) of both differ in chroma (..., 2) and lightness (...), as seen in [0, 1].

        Ratios, so that shading cancels in the chroma, times the brightness, for nobody sees the hue of what is black.
        """
        log_a, log_b = (np.log(np.clip(v, 0, 1) + np.float32(_FLOOR)) for v in (a, b))
        expected = log_a * self.slope.astype(np.float32) + self.offset.astype(np.float32)
        ratio, brightest = log_b - expected, np.maximum(log_b, expected)
        red, green, blue = (brightest[..., c] for c in range(3))
        bright = np.minimum(np.exp(np.maximum(np.maximum(red, green), blue)), 1)
        red, green, blue = (ratio[..., c] * bright for c in range(3))
        return np.stack([red - green, blue - green], axis=-1), (red + green + blue) / 3


IDENTITY = Balance(np.ones(3), np.zeros(3), 0.0, 0.0)


def balance(a: np.ndarray, b: np.ndarray) -> Balance:
    """The robust line from colours a (K, 3) to b (K, 3) of the same surfaces; the identity where there are too few."""
    if len(a) < _FEWEST:
        return IDENTITY
    step = max(1, len(a) // _SAMPLES)
    x, y = (np.log(np.clip(v[::step], 0, 1).astype(np.float64) + _FLOOR) for v in (a, b))
    slope, offset = np.ones(3), np.median(y - x, axis=0)
    for channel in range(3):
        for _ in range(_ROUNDS):
            left = y[:, channel] - slope[channel] * x[:, channel] - offset[channel]
            # Cauchy weights: what changed its colour may be a third of what is seen, and must not bend the line.
            scale = max(1.4826 * float(np.median(np.abs(left))), 1e-4)
            weight = 1 / (1 + (left / (1.5 * scale)) ** 2)
            mean_x, mean_y = np.average(x[:, channel], weights=weight), np.average(y[:, channel], weights=weight)
            centred = x[:, channel] - mean_x
            # A prior towards slope 1: a place of one colour tells an offset and no slope.
            prior = 0.01 * weight.sum()
            covariance = (weight * centred * (y[:, channel] - mean_y)).sum() + prior
            slope[channel] = np.clip(covariance / ((weight * centred**2).sum() + prior), 0.4, 2.5)
            offset[channel] = mean_y - slope[channel] * mean_x
    line = Balance(slope, offset, 0.0, 0.0)
    chroma, lightness = line.differences(a[::step], b[::step])
    spread = 1.4826 * float(np.median(np.maximum(*np.abs(chroma).T)))
    return Balance(slope, offset, spread, 1.4826 * float(np.median(np.abs(lightness))))


def differ(line: Balance, chroma: np.ndarray, lightness: np.ndarray, params: Params) -> np.ndarray:
    """Where colours differ by more than light and noise explain."""
    return (
        np.maximum(np.abs(chroma[..., 0]), np.abs(chroma[..., 1]))
        > max(params.min_chroma, params.colour_spreads * line.chroma_spread)
    ) | (np.abs(lightness) > max(params.min_lightness, params.colour_spreads * line.lightness_spread))

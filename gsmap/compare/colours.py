"""Compute colour differences of two captures after balancing exposure and white balance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap._native import tones_apart

FLOOR = 0.03  # added to colours before taking logarithms, because darker colours are noise
_SAMPLES = 40_000  # largest number of pixels to which a line is fitted
_ROUNDS = 6
_FEWEST = 200  # smallest number of pixels to which a line is fitted
_MIN_CHROMA, _MIN_LIGHTNESS = 0.06, 0.2  # smallest differences, of colours in [0, 1], that may be a change
# Largest difference due to exposure and noise, in robust standard deviations.
_CHROMA_SIGMAS, _LIGHTNESS_SIGMAS = 3.0, 5.0


@dataclass(frozen=True, eq=False)
class Balance:
    """Map from the colours of one capture to those of another capture: ``log b = slope * log a + offset``, per channel.

    The line models gain, gamma and white balance of display colours.

    Args:
        slope, offset: (3,) coefficients of the line per channel.
        chroma_spread, lightness_spread: robust standard deviations of the residuals where both captures agree.
    """

    slope: np.ndarray
    offset: np.ndarray
    chroma_spread: float
    lightness_spread: float

    def gains(self) -> np.ndarray:
        """Return the (3,) factors that convert a middle grey of the first capture to the second."""
        grey = np.log(0.5)
        out: np.ndarray = np.exp((self.slope - 1) * grey + self.offset)
        return out

    def applied(self, colour: np.ndarray) -> np.ndarray:
        """Return colours (..., 3) of the first capture, converted to the exposure of the second."""
        logs = np.log(np.clip(colour, 0, 1) + np.float32(FLOOR))
        out = np.exp(logs * self.slope.astype(np.float32) + self.offset.astype(np.float32)) - np.float32(FLOOR)
        return np.clip(out, 0, 1).astype(np.float32)

    def differences(self, a: np.ndarray, b: np.ndarray, both: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the differences between two images (H, W, 3) of one view: chroma (H, W, 2) and lightness (H, W).

        The differences are ratios, so that shading cancels in the chroma, multiplied by the brightness, because the hue
        of black is not visible. A difference that a neighbouring pixel explains is dropped, because texture that is
        shifted by half a pixel is no change of colour.

        Args:
            both: (H, W) mask of pixels that show the same surface in both images; only these explain a difference.
        """
        apart, brightest = tones_apart(
            a=log_colours(a),
            b=log_colours(b),
            both=both,
            slope=self.slope.astype(np.float32),
            offset=self.offset.astype(np.float32),
        )
        apart *= np.minimum(np.exp(brightest), 1)[..., None]
        return np.ascontiguousarray(apart[..., :2]), np.ascontiguousarray(apart[..., 2])

    def left_over(self, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the differences between single colours (K, 3): chroma (K, 2) and lightness (K,)."""
        log_a, log_b = (np.log(np.clip(v, 0, 1) + np.float32(FLOOR)) for v in (a, b))
        log_a = log_a * self.slope + self.offset
        bright = np.minimum(np.exp(largest_channel(np.maximum(log_a, log_b))), 1)
        red, blue, light = ((y - x) * bright for x, y in zip(_tones(log_a), _tones(log_b), strict=True))
        return np.stack([red, blue], axis=-1), light


def log_colours(colour: np.ndarray) -> np.ndarray:
    """Return the logarithms of colours (..., 3), float32, that are compared."""
    out: np.ndarray = np.log(np.clip(colour, 0, 1) + np.float32(FLOOR))
    return out


def largest_channel(values: np.ndarray) -> np.ndarray:
    """Return the (...,) largest of three channels (..., 3), far faster than ``max`` along short rows."""
    out: np.ndarray = np.maximum(np.maximum(values[..., 0], values[..., 1]), values[..., 2])
    return out


def _tones(logs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return red over green, blue over green, and lightness, from logarithms of colours (..., 3)."""
    red, green, blue = logs[..., 0], logs[..., 1], logs[..., 2]
    return red - green, blue - green, (red + green + blue) / 3


IDENTITY = Balance(np.ones(3), np.zeros(3), 0.0, 0.0)


def balance(a: np.ndarray, b: np.ndarray) -> Balance:
    """Fit a robust line from colours a (K, 3) to colours b (K, 3) of the same surfaces; the identity if there are too
    few pixels."""
    if len(a) < _FEWEST:
        return IDENTITY
    step = max(1, len(a) // _SAMPLES)
    x, y = (np.log(np.clip(v[::step], 0, 1).astype(np.float64) + FLOOR) for v in (a, b))
    slope, offset = np.ones(3), np.median(y - x, axis=0)
    for channel in range(3):
        for _ in range(_ROUNDS):
            left = y[:, channel] - slope[channel] * x[:, channel] - offset[channel]
            # Cauchy weights: a third of the pixels may show recoloured surfaces, which must not bias the line.
            scale = max(1.4826 * float(np.median(np.abs(left))), 1e-4)
            weight = 1 / (1 + (left / (1.5 * scale)) ** 2)
            mean_x, mean_y = np.average(x[:, channel], weights=weight), np.average(y[:, channel], weights=weight)
            centred = x[:, channel] - mean_x
            # A prior favours a slope of 1, because a place of one colour determines an offset but no slope.
            prior = 0.01 * weight.sum()
            covariance = (weight * centred * (y[:, channel] - mean_y)).sum() + prior
            slope[channel] = np.clip(covariance / ((weight * centred**2).sum() + prior), 0.4, 2.5)
            offset[channel] = mean_y - slope[channel] * mean_x
    line = Balance(slope, offset, 0.0, 0.0)
    chroma, lightness = line.left_over(a[::step], b[::step])
    spread = 1.4826 * float(np.median(np.maximum(*np.abs(chroma).T)))
    return Balance(slope, offset, spread, 1.4826 * float(np.median(np.abs(lightness))))


def difference_limits(line: Balance) -> tuple[float, float]:
    """Return the largest differences of chroma and of lightness that lighting and noise explain."""
    return (
        max(_MIN_CHROMA, _CHROMA_SIGMAS * line.chroma_spread),
        max(_MIN_LIGHTNESS, _LIGHTNESS_SIGMAS * line.lightness_spread),
    )


def colours_differ(line: Balance, chroma: np.ndarray, lightness: np.ndarray) -> np.ndarray:
    """Return a mask of colours that differ by more than lighting and noise explain."""
    most = np.maximum(np.abs(chroma[..., 0]), np.abs(chroma[..., 1]))
    out: np.ndarray = (most > difference_limits(line)[0]) | (np.abs(lightness) > difference_limits(line)[1])
    return out

"""Windows that move over pictures: blurred, means, highest values; (H, W) or (H, W, C), float32.

As `scipy.ndimage` has them, in a tenth of its time.
"""

from __future__ import annotations

import numpy as np

from gsmap._native import highest as native_highest
from gsmap._native import slopes as native_slopes
from gsmap._native import smoothed


def blurred(image: np.ndarray, sigma_px: float, truncate: float = 4.0, *, reflect: bool = True) -> np.ndarray:
    """An image less what is finer than a Gaussian.

    Args:
        truncate: it ends after so many standard deviations.
        reflect: beyond its edges the image goes on as in a mirror, else as its last row.
    """
    reach = int(truncate * sigma_px + 0.5)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma_px) ** 2)
    return _smoothed(image, weights / weights.sum(), reflect)


def means(image: np.ndarray, size_px: int, *, reflect: bool = True, first: int = 0, step: int = 1) -> np.ndarray:
    """Means over squares of ``size_px`` (odd) around every pixel, or around those of ``[first::step, first::step]``."""
    return _smoothed(image, np.full(size_px, 1 / size_px), reflect, first, step)


def highest(image: np.ndarray, size_px: int) -> np.ndarray:
    """The highest values over squares of ``size_px`` around every pixel, of an even number more of them before it."""
    out: np.ndarray = native_highest(_deep(image), size_px // 2, (size_px - 1) // 2)
    return out.reshape(image.shape)


def lowest(image: np.ndarray, size_px: int) -> np.ndarray:
    """The lowest values, likewise."""
    return -highest(-image, size_px)


def slopes(image: np.ndarray) -> np.ndarray:
    """(H, W, 2, ...) how an image changes from row to row and from column to column, by central differences."""
    out: np.ndarray = native_slopes(_deep(image))
    return out.reshape(*image.shape[:2], 2, *image.shape[2:])


def _smoothed(image: np.ndarray, weights: np.ndarray, reflect: bool, first: int = 0, step: int = 1) -> np.ndarray:
    out: np.ndarray = smoothed(_deep(image), weights.astype(np.float32), reflect, first, step)
    return out.reshape(*out.shape[:2], *image.shape[2:])


def _deep(image: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(image, np.float32).reshape(*image.shape[:2], -1)

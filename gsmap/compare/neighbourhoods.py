"""Filters of images over 3 x 3 pixels."""

from __future__ import annotations

import numpy as np

from gsmap._native import depth_ranges


def depth_extremes(depth: np.ndarray, opaque: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the (H, W) lowest and highest opaque depth over 3 x 3 pixels; inf and -inf without opaque pixels."""
    found: tuple[np.ndarray, np.ndarray] = depth_ranges(depth=np.ascontiguousarray(depth), opaque=opaque)
    return found


def erode(mask: np.ndarray) -> np.ndarray:
    """Erode a mask (H, W) by one pixel."""
    return over_3x3(mask, np.logical_and)


def dilate(mask: np.ndarray, times: int = 1) -> np.ndarray:
    """Dilate a mask (H, W) by ``times`` pixels."""
    for _ in range(times):
        mask = over_3x3(mask, np.logical_or)
    return mask


def over_3x3(values: np.ndarray, pick: np.ufunc) -> np.ndarray:
    """Reduce each pixel's 3 x 3 neighbourhood by a ufunc such as ``minimum``."""
    rows = values.copy()
    pick(rows[1:], values[:-1], out=rows[1:])
    pick(rows[:-1], values[1:], out=rows[:-1])
    out: np.ndarray = rows.copy()
    pick(out[:, 1:], rows[:, :-1], out=out[:, 1:])
    pick(out[:, :-1], rows[:, 1:], out=out[:, :-1])
    return out


def local_ranges(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the (H, W, K) lowest and highest value of each channel over 3 x 3 pixels."""
    channels = [picture[..., c] for c in range(picture.shape[-1])]
    low, high = (np.stack([over_3x3(c, pick) for c in channels], axis=-1) for pick in (np.minimum, np.maximum))
    return low, high

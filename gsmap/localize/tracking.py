"""Track patches of a render in a photo taken from nearly the same pose, by normalized cross-correlation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2

from gsmap.geometry.filters import blur, box_means, gradients, maximum

MAX_PATCHES = 400
"""Number of patches of one render: those with most structure."""

_HALF_PX = 7  # half width of a patch
_CELL_PX = 14  # each cell of this size gives at most one patch
_MIN_STRUCTURE = 0.012  # smallest standard deviation along the direction that varies least, grey in [0, 1]
_MIN_CORRELATION = 0.6
_MIN_MARGIN = 0.04  # lead of the best correlation over all correlations farther away than ...
_RIVAL_PX = 3  # ... this distance
_SMOOTH_PX = 0.8  # blur of the render before its structure is measured


@dataclass(frozen=True, eq=False)
class PatchTracks:
    """Patches of a render that were searched for in a photo.

    Args:
        render_px: (K, 2) centres in the render, ``column row`` with pixel centres at +0.5.
        photo_px: (K, 2) positions in the photo.
        correlation: (K,) normalized correlation in [-1, 1].
        found: (K,) mask of patches that are correlated, unique, and not at the border of the search window.
    """

    render_px: np.ndarray
    photo_px: np.ndarray
    correlation: np.ndarray
    found: np.ndarray


def track(render: np.ndarray, valid: np.ndarray, photo: np.ndarray, reach_px: int) -> PatchTracks:
    """Search for patches of a render in a photo of the same size, within ``reach_px`` of their position in the render.

    Args:
        render, photo: (H, W) float32 grey in [0, 1].
        valid: (H, W) mask of pixels of the render with a known position.
    """
    half = _HALF_PX
    row, column = _corners(render, valid)
    side = 2 * half + 1
    if not len(row):
        empty = np.zeros((0, 2))
        return PatchTracks(empty, empty, np.zeros(0), np.zeros(0, bool))
    offsets = np.arange(-half, half + 1)
    patches = render[row[:, None, None] + offsets[:, None], column[:, None, None] + offsets]
    patches = patches - patches.mean((1, 2), keepdims=True)
    patches /= np.maximum(np.linalg.norm(patches, axis=(1, 2), keepdims=True), 1e-6)
    margin = half + reach_px
    padded = np.pad(photo, margin, mode="edge")
    around = np.arange(-margin, margin + 1)
    windows = padded[row[:, None, None] + margin + around[:, None], column[:, None, None] + margin + around]
    length = next_fast_len(windows.shape[1], real=True)
    products = irfft2(rfft2(windows, (length, length)) * np.conj(rfft2(patches, (length, length))), (length, length))
    span = 2 * reach_px + 1
    products = products[:, :span, :span]
    mean = box_means(photo, side, reflect=False)
    spread = np.sqrt(np.maximum(box_means(photo**2, side, reflect=False) - mean**2, 0)) * side
    near = np.arange(-reach_px, reach_px + 1)
    spread = np.pad(spread, reach_px, mode="constant")[
        row[:, None, None] + reach_px + near[:, None], column[:, None, None] + reach_px + near
    ]
    scores = np.where(spread > 0.01 * side, products / np.maximum(spread, 1e-6), -1.0)
    flat = scores.reshape(len(scores), -1)
    best = flat.argmax(axis=1)
    top = flat[np.arange(len(flat)), best]
    i, j = np.divmod(best, span)
    inside = (i > 0) & (i < span - 1) & (j > 0) & (j < span - 1)
    ci, cj = np.clip(i, 1, span - 2), np.clip(j, 1, span - 2)
    k = np.arange(len(flat))
    di = _vertex(scores[k, ci - 1, cj], scores[k, ci, cj], scores[k, ci + 1, cj])
    dj = _vertex(scores[k, ci, cj - 1], scores[k, ci, cj], scores[k, ci, cj + 1])
    apart = np.maximum(np.abs(np.arange(span) - i[:, None])[:, :, None], np.abs(np.arange(span) - j[:, None])[:, None])
    rival = np.where(apart > _RIVAL_PX, scores, -1.0).max((1, 2))
    found = inside & (top >= _MIN_CORRELATION) & (top - rival >= _MIN_MARGIN)
    at = np.stack([column + 0.5, row + 0.5], axis=1)
    return PatchTracks(at, at + np.stack([j + dj - reach_px, i + di - reach_px], axis=1), top, found)


def _corners(grey: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of the strongest corners (Shi and Tomasi 1994), one per cell."""
    half = _HALF_PX
    smooth = blur(grey, _SMOOTH_PX)
    gy, gx = np.moveaxis(gradients(smooth), 2, 0)
    size = 2 * half - 1
    a, b, c = np.moveaxis(box_means(np.stack([gx * gx, gx * gy, gy * gy], axis=2), size), 2, 0)
    weakest = (a + c) / 2 - np.sqrt(np.maximum(((a - c) / 2) ** 2 + b * b, 0))
    weakest[~valid] = 0
    edge = half + 1
    weakest[:edge], weakest[-edge:], weakest[:, :edge], weakest[:, -edge:] = 0, 0, 0, 0
    peak = (weakest == maximum(weakest, _CELL_PX)) & (weakest > (_MIN_STRUCTURE / half) ** 2)
    row, column = np.nonzero(peak)
    order = np.argsort(-weakest[row, column], kind="stable")[:MAX_PATCHES]
    return row[order], column[order]


def _vertex(before: np.ndarray, at: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the vertex of the parabola through three values, relative to the middle value, within half a step."""
    bend = before - 2 * at + after
    safe = np.where(bend < -1e-9, bend, -1e-9)
    out: np.ndarray = np.where(bend < -1e-9, np.clip(0.5 * (before - after) / safe, -0.5, 0.5), 0.0)
    return out

"""Where the patches of a render lie in a photograph, once both show a place from nearly the same standpoint."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2

from gsmap.localize.filters import blurred, highest, means, slopes


@dataclass(frozen=True)
class Params:
    """How patches are chosen and found again.

    Args:
        half_px: a patch reaches so far from its middle.
        cell_px: of each cell of this size one patch is taken at most: that with most structure.
        max_patches: of one render.
        min_structure: least contrast (standard deviation, grey in [0, 1]) along the direction that varies least.
        min_correlation: normalised cross-correlation under which a patch is not found again.
        min_margin: by which the best place must beat every other that is more than ``apart_px`` away.
        apart_px: see there.
    """

    half_px: int = 7
    cell_px: int = 14
    max_patches: int = 400
    min_structure: float = 0.012
    min_correlation: float = 0.6
    min_margin: float = 0.04
    apart_px: int = 3


@dataclass(frozen=True, eq=False)
class Tracks:
    """Patches of a render that were looked for in a photo.

    Args:
        render_px: (K, 2) their middles in the render, ``column row`` with pixel centres at +0.5.
        photo_px: (K, 2) where they were found.
        correlation: (K,) how well, in [-1, 1].
        found: (K,) bool: well enough, once only, and not at the edge of what was searched.
    """

    render_px: np.ndarray
    photo_px: np.ndarray
    correlation: np.ndarray
    found: np.ndarray


def track(render: np.ndarray, usable: np.ndarray, photo: np.ndarray, reach_px: int, params: Params) -> Tracks:
    """Look for patches of a render in a photo of the same size, within ``reach_px`` of where they lie in the render.

    Args:
        render, photo: (H, W) float32 grey in [0, 1].
        usable: (H, W) bool: pixels of the render whose place is known.
    """
    half = params.half_px
    row, column = _corners(render, usable, params)
    side = 2 * half + 1
    if not len(row):
        empty = np.zeros((0, 2))
        return Tracks(empty, empty, np.zeros(0), np.zeros(0, bool))
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
    mean = means(photo, side, reflect=False)
    spread = np.sqrt(np.maximum(means(photo**2, side, reflect=False) - mean**2, 0)) * side
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
    rival = np.where(apart > params.apart_px, scores, -1.0).max((1, 2))
    found = inside & (top >= params.min_correlation) & (top - rival >= params.min_margin)
    at = np.stack([column + 0.5, row + 0.5], axis=1)
    return Tracks(at, at + np.stack([j + dj - reach_px, i + di - reach_px], axis=1), top, found)


def _corners(grey: np.ndarray, usable: np.ndarray, params: Params) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pixels around which most varies in every direction, one a cell."""
    half = params.half_px
    smooth = blurred(grey, 0.8)
    gy, gx = np.moveaxis(slopes(smooth), 2, 0)
    size = 2 * half - 1
    a, b, c = np.moveaxis(means(np.stack([gx * gx, gx * gy, gy * gy], axis=2), size), 2, 0)
    weakest = (a + c) / 2 - np.sqrt(np.maximum(((a - c) / 2) ** 2 + b * b, 0))
    weakest[~usable] = 0
    edge = half + 1
    weakest[:edge], weakest[-edge:], weakest[:, :edge], weakest[:, -edge:] = 0, 0, 0, 0
    peak = (weakest == highest(weakest, params.cell_px)) & (weakest > (params.min_structure / half) ** 2)
    row, column = np.nonzero(peak)
    order = np.argsort(-weakest[row, column], kind="stable")[: params.max_patches]
    return row[order], column[order]


def _vertex(before: np.ndarray, at: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Where the parabola through three values one apart is highest, from the middle, within half a step."""
    bend = before - 2 * at + after
    safe = np.where(bend < -1e-9, bend, -1e-9)
    out: np.ndarray = np.where(bend < -1e-9, np.clip(0.5 * (before - after) / safe, -0.5, 0.5), 0.0)
    return out

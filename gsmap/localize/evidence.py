"""Compare a photo, patch by patch, with renders from the photo's pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from gsmap.geometry.filters import box_means
from gsmap.localize.candidate_renders import GREY, SceneRender, downsample, downsample_mask
from gsmap.localize.mismatch import MismatchMap

HALF_PX = 8
"""Half width of the compared patches, in pixels."""

STEP_PX = 8
"""Distance between the centres of neighbouring patches, in pixels."""

EXPLAINED_CORRELATION, CONTRADICTED_CORRELATION = 0.5, 0.15
"""Normalized correlations: from the first on the map explains a patch, below the second the map is contradicted."""

COARSE = 4
"""Factor by which images are reduced for the second comparison, at which renders are as sharp as photos."""

_MIN_CONTRAST = 0.02  # a patch is compared if photo or render has this standard deviation, grey in [0, 1]
_BLOCKING_M = 0.1  # a surface nearer than this blocks the camera


@dataclass(frozen=True, eq=False)
class RenderComparison:
    """Agreement of a photo with renders from one pose.

    Args:
        correlation: (R, C) correlation of each patch with the best scene; NaN if it cannot be compared.
        seen: share of the photo in which at least one scene is opaque.
        colour: correlation over patches between the chroma of photo and renders; NaN if both are grey.
        blocked: share of the photo in which a surface blocks the camera.
    """

    correlation: np.ndarray
    seen: float
    colour: float
    blocked: float

    def explained(self, min_correlation: float = EXPLAINED_CORRELATION) -> float:
        """Return the share of compared patches that the map explains; 0 without compared patches."""
        compared = self.correlation[np.isfinite(self.correlation)]
        return float((compared >= min_correlation).mean()) if len(compared) else 0.0

    def contradicted(self) -> float:
        """Return the share of compared patches that contradict the map; 0 without compared patches."""
        compared = self.correlation[np.isfinite(self.correlation)]
        return float((compared < CONTRADICTED_CORRELATION).mean()) if len(compared) else 0.0

    @property
    def num_compared(self) -> int:
        return int(np.isfinite(self.correlation).sum())


def compare(
    rgb: np.ndarray,
    renders: Sequence[SceneRender],
    mismatch: MismatchMap | None = None,
    reduction: int = 1,
    mask: np.ndarray | None = None,
    step_px: int = STEP_PX,
) -> RenderComparison:
    """Compare a photo (H, W, 3), float32 in [0, 1], with renders from the photo's pose.

    Args:
        mismatch: mismatch map, whose largest part is excluded.
        reduction: ratio of the photo's size at which the mismatch map was computed to this size.
        mask: (H, W) mask of valid pixels of the photo; None if all are valid.
    """
    grey = rgb @ GREY
    around = partial(_patch_means, rows=rgb.shape[0] - 2 * HALF_PX, columns=rgb.shape[1] - 2 * HALF_PX, step_px=step_px)
    mean, square, photo_colour = around(grey), around(grey * grey), around(rgb)
    variance = np.maximum(square - mean**2, 0)
    best = np.full(mean.shape, -np.inf, np.float32)
    compared = np.zeros(best.shape, bool)
    included = np.ones(best.shape, bool)
    if mismatch is not None:
        included = ~mismatch.covers(best.shape, reduction * HALF_PX, reduction * step_px)
    seen, blocked = np.zeros(grey.shape, bool), np.zeros(grey.shape, bool)
    render_colour = np.zeros((*best.shape, 3), np.float32)
    for one in renders:
        opaque = one.alpha > 0.9
        if mask is not None:
            opaque &= mask
        seen |= opaque
        blocked |= opaque & (one.depth_m < _BLOCKING_M)
        level = around(one.grey)
        spread = np.maximum(around(one.grey**2) - level**2, 0)
        both = around(grey * one.grey) - mean * level
        correlation = both / np.sqrt(np.maximum(variance * spread, 1e-12))
        whole = included & (around(opaque.astype(np.float32)) > 0.95)
        valid = whole & (np.maximum(variance, spread) > _MIN_CONTRAST**2) & (np.minimum(variance, spread) > 4e-5)
        correlation = np.where(valid, correlation, -np.inf)
        better = correlation > best
        render_colour[better] = around(one.rgb)[better]
        best = np.maximum(best, correlation)
        compared |= valid
    best = np.where(compared, best, np.nan)
    valid_share = 1.0 if mask is None else max(float(mask.mean()), 1e-9)
    shares = float(seen.mean()) / valid_share, float(blocked.mean()) / valid_share
    return RenderComparison(
        best, shares[0], _chroma_correlation(photo_colour[compared], render_colour[compared]), shares[1]
    )


def _patch_means(image: np.ndarray, rows: int, columns: int, step_px: int) -> np.ndarray:
    """Return the means over the patches that lie completely within the photo."""
    found = box_means(image, 2 * HALF_PX + 1, first=HALF_PX, step=step_px)
    return found[: -(-rows // step_px), : -(-columns // step_px)]


def compare_coarsely(
    rgb: np.ndarray,
    renders: Sequence[SceneRender],
    mismatch: MismatchMap | None = None,
    mask: np.ndarray | None = None,
) -> RenderComparison:
    """Compare as `compare` does, at a size reduced by `COARSE`, with patches of the same number of pixels."""
    small = [one.downsampled(COARSE) for one in renders]
    return compare(downsample(rgb, COARSE), small, mismatch, COARSE, downsample_mask(mask, COARSE), HALF_PX // 2)


def _chroma_correlation(photo: np.ndarray, rendered: np.ndarray) -> float:
    """Return the correlation of two log ratios of channels, which brightness and white balance do not change."""
    if len(photo) < 12:
        return float("nan")
    products, squares = 0.0, [0.0, 0.0]
    for one, two in ((0, 1), (2, 1)):
        a, b = (np.log((x[:, one] + 0.02) / (x[:, two] + 0.02)) for x in (photo, rendered))
        a, b = a - a.mean(), b - b.mean()
        products += float(a @ b)
        squares[0] += float(a @ a)
        squares[1] += float(b @ b)
    if min(squares) < 1e-4 * len(photo):
        return float("nan")
    return products / float(np.sqrt(squares[0] * squares[1]))

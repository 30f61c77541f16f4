"""What speaks for and against a photograph's place: what the map shows from there, beside what the photograph shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from gsmap.localize.filters import means
from gsmap.localize.looks import GREY, Look, smaller, wholly
from gsmap.localize.unlike import Unlike


@dataclass(frozen=True)
class Params:
    """How a photograph is compared with renders.

    Args:
        half_px: patterns are compared within patches that reach so far from their middle.
        step_px: from one patch to the next.
        min_structure: least contrast of a patch (standard deviation, grey in [0, 1]) in the photo or the render, for it
            to be compared.
        agree: normalised correlation from which on a patch is explained.
        contradict: ... and under which it shows something else.
        inlier_px: a patch that is found again this near to where the pose predicts it is an inlier, at 480 pixels.
        blocks: columns and rows of the picture over which inliers should be spread.
        coarse: patterns are compared once more in pictures so many times smaller, where renders are as sharp as photos.
        likely, surely: so probably a cell of the photo shows something else than the map (`gsmap.localize.unlike`).
        ask_from: where all else leaves a lower probability at most, that is not asked.
        near_m: surfaces nearer than this stand in a camera's face.
    """

    half_px: int = 8
    step_px: int = 8
    min_structure: float = 0.02
    agree: float = 0.5
    contradict: float = 0.15
    inlier_px: float = 2.0
    blocks: tuple[int, int] = (8, 6)
    coarse: int = 4
    likely: float = 0.5
    surely: float = 0.8
    ask_from: float = 0.05
    near_m: float = 0.1


@dataclass(frozen=True, eq=False)
class Comparison:
    """A photograph beside what the map shows from one pose.

    Args:
        correlation: (R, C) of each patch with that scene's that shows it best; NaN where nothing can be compared.
        seen: share of the picture where some scene is opaque.
        colour: correlation of the chroma of photo and renders over patches; NaN where neither has any.
        blocked: share of the picture where something stands in the camera's face.
    """

    correlation: np.ndarray
    seen: float
    colour: float
    blocked: float

    def explained(self, agree: float) -> float:
        """Share of the patches that could be compared which agree; 0 of none."""
        judged = self.correlation[np.isfinite(self.correlation)]
        return float((judged >= agree).mean()) if len(judged) else 0.0

    def contradicted(self, bar: float) -> float:
        """Share of the patches that could be compared which show something else; 0 of none."""
        judged = self.correlation[np.isfinite(self.correlation)]
        return float((judged < bar).mean()) if len(judged) else 0.0

    @property
    def num_judged(self) -> int:
        return int(np.isfinite(self.correlation).sum())


def compare(
    rgb: np.ndarray,
    looks: Sequence[Look],
    params: Params,
    other: Unlike | None = None,
    times: int = 1,
    known: np.ndarray | None = None,
) -> Comparison:
    """Compare a photo (H, W, 3) float32 in [0, 1] with renders from its pose.

    Args:
        other: a part of the photo that shows something else is left out.
        times: the photo was so many times larger when that was asked.
        known: (H, W) bool: pixels of the photo that count; None of all.
    """
    grey = rgb @ GREY
    # Of patches around every so many pixels: means of the photo, of its square, and of its colours.
    around = partial(
        _around, rows=rgb.shape[0] - 2 * params.half_px, columns=rgb.shape[1] - 2 * params.half_px, params=params
    )
    mean, square, photo_colour = around(grey), around(grey * grey), around(rgb)
    variance = np.maximum(square - mean**2, 0)
    best = np.full(mean.shape, -np.inf, np.float32)
    judged = np.zeros(best.shape, bool)
    asked = np.ones(best.shape, bool)
    if other is not None:
        asked = ~other.covers(best.shape, times * params.half_px, times * params.step_px)
    seen, blocked = np.zeros(grey.shape, bool), np.zeros(grey.shape, bool)
    shown = np.zeros((*best.shape, 3), np.float32)
    for one in looks:
        opaque = one.alpha > 0.9
        if known is not None:
            opaque &= known
        seen |= opaque
        blocked |= opaque & (one.depth_m < params.near_m)
        level = around(one.grey)
        spread = np.maximum(around(one.grey**2) - level**2, 0)
        both = around(grey * one.grey) - mean * level
        correlation = both / np.sqrt(np.maximum(variance * spread, 1e-12))
        whole = asked & (around(opaque.astype(np.float32)) > 0.95)
        tells = whole & (np.maximum(variance, spread) > params.min_structure**2) & (np.minimum(variance, spread) > 4e-5)
        correlation = np.where(tells, correlation, -np.inf)
        better = correlation > best
        shown[better] = around(one.rgb)[better]
        best = np.maximum(best, correlation)
        judged |= tells
    best = np.where(judged, best, np.nan)
    of_picture = 1.0 if known is None else max(float(known.mean()), 1e-9)
    shares = float(seen.mean()) / of_picture, float(blocked.mean()) / of_picture
    return Comparison(best, shares[0], _chroma(photo_colour[judged], shown[judged]), shares[1])


def _around(image: np.ndarray, rows: int, columns: int, params: Params) -> np.ndarray:
    """Means over the patches that are compared, those that lie wholly within the picture."""
    found = means(image, 2 * params.half_px + 1, first=params.half_px, step=params.step_px)
    return found[: -(-rows // params.step_px), : -(-columns // params.step_px)]


def compare_coarsely(
    rgb: np.ndarray,
    looks: Sequence[Look],
    params: Params,
    other: Unlike | None = None,
    known: np.ndarray | None = None,
) -> Comparison:
    """The same in pictures that are ``coarse`` times smaller, each patch as many pixels wide as before."""
    fewer = replace(params, step_px=params.half_px // 2)
    small = [one.smaller(params.coarse) for one in looks]
    return compare(smaller(rgb, params.coarse), small, fewer, other, params.coarse, wholly(known, params.coarse))


def _chroma(photo: np.ndarray, shown: np.ndarray) -> float:
    """Correlation of two differences of channels, so that neither brightness nor white balance counts."""
    if len(photo) < 12:
        return float("nan")
    products, squares = 0.0, [0.0, 0.0]
    for one, two in ((0, 1), (2, 1)):
        a, b = (np.log((x[:, one] + 0.02) / (x[:, two] + 0.02)) for x in (photo, shown))
        a, b = a - a.mean(), b - b.mean()
        products += float(a @ b)
        squares[0] += float(a @ a)
        squares[1] += float(b @ b)
    if min(squares) < 1e-4 * len(photo):
        return float("nan")
    return products / float(np.sqrt(squares[0] * squares[1]))


def spread(pixels: np.ndarray, size_px: tuple[int, int], blocks: tuple[int, int]) -> float:
    """Share of the picture's blocks in which any of the pixels (K, 2) lies."""
    at = np.clip((pixels / size_px * blocks).astype(int), 0, np.array(blocks) - 1)
    return len(np.unique(at[:, 1] * blocks[0] + at[:, 0])) / (blocks[0] * blocks[1])

"""Thin superseded scenes: measure the observed fraction, find visible Gaussians and measure fidelity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.compare import HIDDEN, UNSEEN, CaptureViews, compare, render_views
from gsmap.compare.capture_views import CELL_M, max_per_cell
from gsmap.render import render
from gsmap.settings.ranges import require_range
from gsmap.types import Gaussians, PosedScene

__all__ = ["Params", "measure_fidelity_db", "render_views", "observed_fraction", "find_visible"]


@dataclass(frozen=True)
class Params:
    """Settings of thinning.

    Args:
        min_seen_again: Smallest fraction in [0, 1] of a scene's surface that newer scenes, not thinned themselves, must
            have observed before the scene is thinned; larger thins fewer scenes.
        min_weight: Blending weight in [0, 1] that a Gaussian must reach in at least one view of its scene to be kept;
            larger removes more Gaussians.
        min_fidelity_db: Smallest PSNR in dB that the thinned scene must reach against the original scene, in the
            scene's own views; larger thins fewer scenes. At 43 dB, a scene with a PSNR of 27 dB against its photographs
            loses 0.1 dB.
        max_views: Largest number of views, at least 1 and evenly spread along the camera path, in which the PSNR is
            measured; larger is more reliable and slower.
        longest_side_px: Longest side in pixels, at least 1, of the views in which the PSNR is measured; larger counts
            smaller Gaussians as visible and is slower.
    """

    min_seen_again: float = 0.9
    min_weight: float = 0.01
    min_fidelity_db: float = 43.0
    max_views: int = 24
    longest_side_px: int = 480

    def __post_init__(self) -> None:
        require_range(self, "[0, 1]", "min_seen_again", "min_weight")
        require_range(self, "(0, inf]", "max_views", "longest_side_px")


def observed_fraction(older: PosedScene, newer: Sequence[CaptureViews]) -> float:
    """Return the fraction of a scene's surface that newer scenes in the same frame observed, changed or not.

    Occluded surfaces are not observed; a Gaussian slightly behind an observed surface in the same cell is part of that
    surface.

    Args:
        older: the scene in metres, with its cameras.
        newer: views of the newer scenes, from `gsmap.compare.render_views`.
    """
    mine = render_views(older)
    surface = mine.surface & (mine.times_seen > 0)
    if not surface.any():
        return 0.0
    seen = np.zeros(len(older.gaussians), dtype=bool)
    for other in newer:
        seen |= ~np.isin(compare(mine, other).older.state, (UNSEEN, HIDDEN))
    seen = max_per_cell(older.gaussians.means, seen, CELL_M)
    return float(seen[surface].mean())


def find_visible(scene: PosedScene, params: Params) -> np.ndarray:
    """Return an (N,) mask of Gaussians that are visible in an own view of the scene; all if cameras are missing or
    synthesized."""
    if scene.cameras is None or not len(scene.cameras) or scene.cameras.synthesised:
        return np.ones(len(scene.gaussians), dtype=bool)
    largest = np.zeros(len(scene.gaussians), dtype=np.float32)
    small = scene.cameras.resized(params.longest_side_px)
    for i in range(len(small)):
        seen = render(scene.gaussians, small[i], depth=False, dominant_id=False, max_weight=True)
        np.maximum(largest, seen.max_weight, out=largest)
    out: np.ndarray = largest >= params.min_weight
    return out


def measure_fidelity_db(scene: PosedScene, kept: Gaussians, params: Params) -> float:
    """Measure the PSNR in dB of renders of the kept Gaussians against renders of all, over the scene's own views;
    colours in [0, 1].

    The result is infinite for equal views and NaN without cameras.
    """
    if scene.cameras is None or not len(scene.cameras):
        return float("nan")
    small = scene.cameras.evenly(params.max_views).resized(params.longest_side_px)
    squares = []
    for i in range(len(small)):
        before, after = (
            np.clip(render(g, small[i], depth=False, dominant_id=False).colour[0], 0, 1)
            for g in (scene.gaussians, kept)
        )
        squares.append(float(((before - after) ** 2).mean()))
    error = float(np.mean(squares))
    return float("inf") if error == 0 else -10 * float(np.log10(error))

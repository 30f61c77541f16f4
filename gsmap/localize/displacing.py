"""By how much what a render shows lies elsewhere than its pixel says.

Gaussians that overlap are drawn front to back. On a floor, or any surface that is seen at a slant, those whose middle
lies nearer cover those whose middle lies farther, so a pixel shows more of the former: what belongs further out in the
picture is pulled towards its middle, for nearer is further out. Training takes most of it back, not all: from other
sides another part would have to be taken back. So renders of splats are a little smaller than photographs, the more so
the larger their Gaussians are, and a pose that is found with them lies too near.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.errors import ConfigError
from gsmap.geometry.projection import project
from gsmap.localize.filters import means
from gsmap.localize.placed import PlacedFeatures
from gsmap.render import render


@dataclass(frozen=True)
class Params:
    """How far from its pixel is what a render shows.

    Args:
        share: of the way from a pixel to where the middles of the Gaussians lie that it shows, in their mean by what
            each adds to it; the rest training took back. Made places say so (``tools/fit/localize.py PLACES
            displaced``). 0 leaves it out.
        most_px: that way is cut off here in either direction, at a picture of 480 pixels: larger Gaussians show nothing
            that has a place.
        around_px: its mean over so wide a square counts, at 480 pixels.
        longest_side_px: of the small render that it is asked of.
    """

    share: float = 0.16
    most_px: float = 2.0
    around_px: float = 36.0
    longest_side_px: int = 120

    def __post_init__(self) -> None:
        if not (0 <= self.share <= 1 and self.most_px >= 0 and self.around_px >= 0 and self.longest_side_px >= 8):
            raise ConfigError(
                "of displacing, share lies in [0, 1], most_px and around_px are 0 or more, longest_side_px is 8 or "
                f"more; got share={self.share}, most_px={self.most_px}, around_px={self.around_px}, "
                f"longest_side_px={self.longest_side_px}",
                code="out_of_range",
            )


def displacement(
    scene: PlacedFeatures,
    T_metric_camera: np.ndarray,
    intrinsics_px: np.ndarray,
    size_px: tuple[int, int],
    params: Params,
) -> np.ndarray:
    """(R, C, 2) float32 by how many pixels of a render what it shows lies further right and down, on a coarser grid.

    Args:
        intrinsics_px: (4,) of the render, which is of this size.
    """
    longest = max(size_px)
    by = max(1, round(longest / params.longest_side_px))
    small = (size_px[0] // by, size_px[1] // by)
    camera = scene.camera(T_metric_camera, intrinsics_px / by, small)
    shown = render(scene.coloured_by_place, camera, depth=False, dominant_id=False, backend="native")
    alpha = shown.alpha[0]
    low, span = scene.box
    middles = shown.colour[0] / np.maximum(alpha, 1e-3)[..., None] * span + low
    places = scene.S_metric_scene.apply(middles.reshape(-1, 3).astype(np.float64))
    at, depth = project(places, np.linalg.inv(T_metric_camera), intrinsics_px / by)
    row, column = np.mgrid[0 : small[1], 0 : small[0]]
    away = (at - np.stack([column, row], axis=2).reshape(-1, 2) - 0.5) * by
    away[(depth <= 0) | (alpha.ravel() < 0.9)] = 0
    most = params.most_px * longest / 480
    wide = 2 * round(params.around_px * longest / 480 / by / 2) + 1
    away = np.clip(away, -most, most).reshape(*alpha.shape, 2).astype(np.float32)
    out: np.ndarray = np.float32(params.share) * means(away, wide)
    return out

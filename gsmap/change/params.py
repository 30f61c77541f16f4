"""The settings of finding changes."""

from __future__ import annotations

from dataclasses import dataclass, field

from gsmap import compare
from gsmap.errors import ConfigError


@dataclass(frozen=True)
class Params:
    """How changes between two captures are found.

    Args:
        compare: how the captures are compared.
        cell_m: surfaces are judged by cells of this size.
        voxel_m: size of the cells that a change is reported in.
        reach_m: cells nearer to each other than this belong to one thing.
        min_area_m2: a thing with less changed surface is not reported.
        min_paint: a change of colour is reported from this multiple of ``min_chroma`` or ``min_lightness`` on, and
        most_leak: where no more than this share of it goes on around its edges, as that of light and shadow does.
        min_share: share of the looks of a neighbourhood that must have gone through it for it to have changed.
        min_chroma, min_lightness: colours, in [0, 1], that differ by less, exposure balanced, are one.
        colour_spreads: nor do those within that many robust standard deviations of what agrees.
        yaw_starts: turns about the vertical from which a moved thing is looked for.
        moved_within_m: a moved thing lies this close to where it is said to stand.
        min_moved: share of a thing that fits where it is said to stand, there and back.
        most_ambiguous: a move is not claimed where another fits this share as well, unless it is the thing's symmetry.
        min_confidence: changes less sure than this are not reported.
    """

    compare: compare.Params = field(default_factory=lambda: compare.Params(longest_side_px=160, max_views=40))
    cell_m: float = 0.05
    voxel_m: float = 0.1
    reach_m: float = 0.1
    min_area_m2: float = 0.015
    min_paint: float = 1.9
    most_leak: float = 0.2
    min_share: float = 0.5
    min_chroma: float = 0.05
    min_lightness: float = 0.15
    colour_spreads: float = 3.0
    yaw_starts: int = 24
    moved_within_m: float = 0.05
    min_moved: float = 0.68
    most_ambiguous: float = 0.875
    min_confidence: float = 0.5

    def __post_init__(self) -> None:
        for name in ("cell_m", "voxel_m", "reach_m", "moved_within_m", "yaw_starts"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"change.{name} must be positive, got {getattr(self, name)}")

"""Settings of change detection."""

from __future__ import annotations

from dataclasses import dataclass

from gsmap.settings.ranges import require_range


@dataclass(frozen=True)
class Params:
    """Settings of change detection between two visits.

    Args:
        longest_side_px: Longest side in pixels, at least 1, of the views that both captures are rendered in; larger
            finds smaller changes and takes more time.
        max_views: Largest number of views of each capture that are compared, at least 1; larger misses fewer changes
            and takes more time.
        voxel_m: Edge length in metres, positive, of the voxels in which a change is reported; larger makes reports
            smaller and coarser.
        min_area_m2: Smallest area in square metres, at least 0, of a change that is reported; larger drops small
            changes.
        min_moved_fraction: Smallest fraction in [0, 1] of an object's points in each scene that must fit its points in
            the other scene for the object to be reported as moved; larger reports fewer moves, and more
            pairs of an object that disappeared and one that appeared.
        min_confidence: Smallest probability in [0, 1] of a change that is reported; larger drops doubtful changes.
    """

    longest_side_px: int = 160
    max_views: int = 40
    voxel_m: float = 0.1
    min_area_m2: float = 0.015
    min_moved_fraction: float = 0.68
    min_confidence: float = 0.5

    def __post_init__(self) -> None:
        require_range(self, "[0, inf]", "min_area_m2")
        require_range(self, "[0, 1]", "min_moved_fraction", "min_confidence")
        require_range(self, "(0, inf]", "longest_side_px", "max_views", "voxel_m")

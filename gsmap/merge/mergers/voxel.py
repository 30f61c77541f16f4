"""Merge by voxelization: Gaussians with means in one voxel become one Gaussian with the same moments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.geometry.voxels import merge_groups, voxel_labels
from gsmap.merge.changes import LOOKING_M, MIN_CAMERAS, Prefer, resolve_changes
from gsmap.merge.overlap import concatenate_scenes
from gsmap.settings.ranges import require_range
from gsmap.types import MergeResult, PosedScene
from gsmap.types.progress import Progress

VERSION = 2
STEPS: str | None = None
RENDERS = False


@dataclass(frozen=True)
class Params:
    """Settings of voxelization.

    Args:
        voxel_m: Edge length in metres, positive, of the voxels; all Gaussians in a voxel are merged to one, so larger
            leaves fewer Gaussians.
        prefer: Scene that is shown where scenes of different dates disagree: the ``newest``, the ``best`` observed one,
            or ``both``.
    """

    voxel_m: float = 0.01
    prefer: Prefer = "both"

    def __post_init__(self) -> None:
        require_range(self, "(0, inf]", "voxel_m")


def reach_m(params: Params) -> float:
    # A voxel may cross the border of a tile: both tiles read all of it, and the merged mean decides to which tile it
    # belongs.
    return params.voxel_m


def reading_m(params: Params, dated: bool) -> float:
    return params.voxel_m + (LOOKING_M if dated and uses_dates(params) else 0.0)


def looking_m(params: Params) -> float:
    return LOOKING_M if uses_dates(params) else 0.0


def min_cameras(params: Params) -> int:
    return MIN_CAMERAS if uses_dates(params) else 0


def uses_dates(params: Params) -> bool:
    return params.prefer != "both"


def merge(
    scenes: Sequence[PosedScene],
    params: Params,
    bounds: np.ndarray | None,
    budget_s: float | None,
    progress: Progress,
) -> MergeResult:
    """Merge scenes to one Gaussian per voxel of the map's grid; see `gsmap.geometry.voxels.merge_groups`."""
    settled = resolve_changes(scenes, params.prefer, one_exposure=bounds is None)
    gaussians, origin = concatenate_scenes(settled.scenes)
    merged, heaviest = merge_groups(gaussians, voxel_labels(gaussians.means, params.voxel_m))
    return MergeResult(merged, origin[heaviest], notes=tuple(settled.notes()))

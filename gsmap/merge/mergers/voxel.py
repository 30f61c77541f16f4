"""Voxelisation: the Gaussians of all scenes whose means share a voxel become one with the same moments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.geometry.voxels import merge_groups, voxel_labels
from gsmap.merge.placed import united
from gsmap.types import MergeResult, PlacedScene
from gsmap.types.progress import Progress

VERSION = 1
STEPS: str | None = None
RENDERS = False


@dataclass(frozen=True)
class Params:
    """Moment-preserving voxelisation.

    Args:
        voxel_m: side of a voxel.
    """

    voxel_m: float = 0.01


def reach_m(params: Params) -> float:
    # A voxel may straddle the border: both tiles see all of it, and the merged mean decides whose it is.
    return params.voxel_m


def reading_m(params: Params) -> float:
    return params.voxel_m


def min_cameras(params: Params) -> int:
    return 0


def uses_dates(params: Params) -> bool:
    return False


def merge(
    scenes: Sequence[PlacedScene],
    params: Params,
    bounds: np.ndarray | None,
    budget_s: float | None,
    progress: Progress,
) -> MergeResult:
    """One Gaussian per voxel of the map's grid; see `gsmap.geometry.voxels.merge_groups`."""
    gaussians, origin = united(scenes)
    merged, heaviest = merge_groups(gaussians, voxel_labels(gaussians.means, params.voxel_m))
    return MergeResult(merged, origin[heaviest])

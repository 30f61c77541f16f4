"""Voxelisation: the Gaussians of all parts whose means share a voxel become one with the same moments."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gsmap.geometry.voxels import merge_groups, voxel_labels
from gsmap.merge.parts import MergeResult, Part, united


@dataclass(frozen=True)
class Params:
    """Args:
    voxel_m: side of a voxel.
    """

    voxel_m: float = 0.01


def reach_m(params: Params) -> float:
    # A voxel may straddle the border: both tiles see all of it, and the merged mean decides whose it is.
    return params.voxel_m


def merge(
    parts: list[Part],
    params: Params,
    bounds: np.ndarray | None,
    budget_s: float | None,
    progress: Callable[[float, str], None],
) -> MergeResult:
    """One Gaussian per voxel of the map's grid; see `gsmap.geometry.voxels.merge_groups`."""
    gaussians, origin = united(parts)
    merged, heaviest = merge_groups(gaussians, voxel_labels(gaussians.means, params.voxel_m))
    return MergeResult(merged, origin[heaviest])

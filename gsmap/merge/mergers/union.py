"""Concatenation, as PhotoReg merges: every Gaussian of every scene, ghosts included."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.merge.placed import united
from gsmap.types import MergeResult, PlacedScene
from gsmap.types.progress import Progress

VERSION = 1
STEPS: str | None = None
RENDERS = False


@dataclass(frozen=True)
class Params:
    """Nothing to choose."""


def reach_m(params: Params) -> float:
    return 0.0


def reading_m(params: Params) -> float:
    return 0.0


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
    """All Gaussians of all scenes."""
    return MergeResult(*united(scenes))

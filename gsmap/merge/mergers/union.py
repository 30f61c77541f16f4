"""Merge by concatenation, as in PhotoReg: keep every Gaussian of every scene, including ghosts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.merge.changes import LOOKING_M, MIN_CAMERAS, Prefer, resolve_changes
from gsmap.merge.overlap import concatenate_scenes
from gsmap.types import MergeResult, PosedScene
from gsmap.types.progress import Progress

VERSION = 1
STEPS: str | None = None
RENDERS = False


@dataclass(frozen=True)
class Params:
    """Settings of concatenation.

    Args:
        prefer: Scene that is shown where scenes of different dates disagree: the ``newest``, the ``best`` observed one,
            or ``both``.
    """

    prefer: Prefer = "both"


def reach_m(params: Params) -> float:
    return 0.0


def reading_m(params: Params, dated: bool) -> float:
    return LOOKING_M if dated and uses_dates(params) else 0.0


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
    """Concatenate the Gaussians of all scenes, except those that a preferred scene disproves."""
    settled = resolve_changes(scenes, params.prefer, one_exposure=bounds is None)
    return MergeResult(*concatenate_scenes(settled.scenes), notes=tuple(settled.notes()))

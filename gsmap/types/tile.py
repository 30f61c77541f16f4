"""One piece of an export."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gsmap.types.sim3 import Sim3


@dataclass(frozen=True, eq=False)
class Tile:
    """A written tile: its box, the inputs of its Gaussians, and its file.

    Args:
        key: digest of everything that decides its content but the poses.
        component: connected component it belongs to.
        bounds: (2, 3) float64 lowest and highest corner, map frame; a Gaussian belongs where its mean is
            (``low <= x < high``).
        poses: the ``S_map_scene`` it was made with, by scene id.
        num_gaussians: number of it holds.
        recipe: `gsmap.methods.RecipeKey.to_json` of what made it.
        truncated: a time budget cut its optimisation short.
        path: relative to the export's folder.
        sha256: of the file written.
        notes: remarks on how it was merged.
        up: vertical axis of the file: ``z`` if it has the map's axes, ``y`` if it is turned (x, -z, y) for viewers.
    """

    key: str
    component: int
    bounds: np.ndarray
    poses: dict[str, Sim3] = field(default_factory=dict)
    num_gaussians: int = 0
    recipe: dict[str, Any] = field(default_factory=dict)
    truncated: bool = False
    path: str = ""
    sha256: str = ""
    notes: tuple[str, ...] = ()
    up: str = "z"

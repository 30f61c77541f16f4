"""Which captures newer ones supersede, and what of such a capture has to be kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from gsmap.compare import HIDDEN, UNSEEN, Looks, compare, look
from gsmap.compare import Params as CompareParams
from gsmap.compare.looks import best_of_cell
from gsmap.errors import ConfigError
from gsmap.render import render
from gsmap.types import Gaussians, PlacedScene

__all__ = ["Params", "fidelity_db", "look", "seen_again", "shown"]


@dataclass(frozen=True)
class Params:
    """When a capture may be kept compact, and how.

    Args:
        min_seen_again: share of its surface that newer captures, kept whole, must have looked at.
        min_weight: a Gaussian that nowhere makes up this share of a pixel of its capture's own pictures goes.
        min_fidelity_db: PSNR of what is kept against what there was, in the capture's own pictures: with less, it stays
            as it is. At 43 dB a capture that fits its photographs at 27 dB loses 0.1 dB of that.
        pictures: of its own that are compared; evenly along its path.
        longest_side_px: size of these.
        compare: what counts as looked at.
    """

    min_seen_again: float = 0.9
    min_weight: float = 0.01
    min_fidelity_db: float = 43.0
    pictures: int = 24
    longest_side_px: int = 480
    compare: CompareParams = field(default_factory=CompareParams)

    def __post_init__(self) -> None:
        for name in ("min_seen_again", "min_weight"):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigError(f"{name} must be a share in [0, 1], got {getattr(self, name)}")
        for name in ("pictures", "longest_side_px"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be positive, got {getattr(self, name)}")


def seen_again(older: PlacedScene, newer: Sequence[Looks], params: CompareParams | None = None) -> float:
    """Share of a capture's surface that newer captures of the same frame looked at, whatever they found there.

    What stands behind what they show, they did not look at; what lies a little behind in a cell of which they saw the
    rest is of the surface that they saw.

    Args:
        older: in metres, with its cameras.
        newer: see `gsmap.compare.look`.
    """
    params = params or CompareParams()
    mine = look(older, params)
    surface = mine.surface & (mine.times_seen > 0)
    if not surface.any():
        return 0.0
    seen = np.zeros(len(older.gaussians), dtype=bool)
    for other in newer:
        seen |= ~np.isin(compare(mine, other, params).older.state, (UNSEEN, HIDDEN))
    seen = best_of_cell(older.gaussians.means, seen, params.cell_m)
    return float(seen[surface].mean())


def shown(scene: PlacedScene, params: Params) -> np.ndarray:
    """(N,) bool, which Gaussians show in any of a capture's own pictures; all where its cameras are none or made up."""
    if scene.cameras is None or not len(scene.cameras) or scene.cameras.synthesised:
        return np.ones(len(scene.gaussians), dtype=bool)
    largest = np.zeros(len(scene.gaussians), dtype=np.float32)
    small = scene.cameras.resized(params.longest_side_px)
    for i in range(len(small)):
        seen = render(scene.gaussians, small[i], depth=False, dominant_id=False, max_weight=True)
        np.maximum(largest, seen.max_weight, out=largest)
    out: np.ndarray = largest >= params.min_weight
    return out


def fidelity_db(scene: PlacedScene, kept: Gaussians, params: Params) -> float:
    """PSNR in dB, colours in [0, 1], of what is kept of a capture against all of it, over its own pictures.

    Infinite where nothing differs, NaN where it has no cameras.
    """
    if scene.cameras is None or not len(scene.cameras):
        return float("nan")
    small = scene.cameras.evenly(params.pictures).resized(params.longest_side_px)
    squares = []
    for i in range(len(small)):
        before, after = (
            np.clip(render(g, small[i], depth=False, dominant_id=False).colour[0], 0, 1)
            for g in (scene.gaussians, kept)
        )
        squares.append(float(((before - after) ** 2).mean()))
    error = float(np.mean(squares))
    return float("inf") if error == 0 else -10 * float(np.log10(error))

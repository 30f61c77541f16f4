"""No refinement: the pose stays as it is."""

from __future__ import annotations

from dataclasses import dataclass

from gsmap.methods.refiner import Surface
from gsmap.types import Sim3

VERSION = 1
SCALES = True


@dataclass(frozen=True)
class Params:
    """Nothing to set."""


def refine(
    target: Surface, source: Surface, start: Sim3, params: Params | None = None, *, with_scale: bool = False
) -> Sim3:
    """The start."""
    return start

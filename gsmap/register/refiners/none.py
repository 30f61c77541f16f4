"""Return the initial pose without refinement."""

from __future__ import annotations

from dataclasses import dataclass

from gsmap.methods.refiner import Surface
from gsmap.types import Sim3

VERSION = 1
SCALES = True


@dataclass(frozen=True)
class Params:
    """Settings of the method: none."""


def refine(
    target: Surface, source: Surface, start: Sim3, params: Params | None = None, *, with_scale: bool = False
) -> Sim3:
    """Return the start."""
    return start

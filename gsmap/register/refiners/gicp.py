"""Refine a rigid pose by generalised ICP (Segal et al. 2009), coarse to fine."""

from __future__ import annotations

from dataclasses import dataclass

from gsmap.methods.refiner import Surface
from gsmap.register.refiners._small_gicp import align
from gsmap.types import Sim3

VERSION = 1
SCALES = False

_RADII_M = (0.35, 0.12, 0.06)  # correspondence distances, one run each, coarse to fine
_MAX_ITERATIONS = 20  # of each run


@dataclass(frozen=True)
class Params:
    """Settings of generalised ICP: none."""


def refine(
    target: Surface, source: Surface, start: Sim3, params: Params | None = None, *, with_scale: bool = False
) -> Sim3:
    """Align two surfaces (metres) by GICP (small_gicp) from an initial pose within about 8 degrees.

    The scale of the start is kept. Returns the start where the overlap is too small.
    """
    return align("GICP", target, source, start, radii_m=_RADII_M, max_iterations=_MAX_ITERATIONS)

"""Refine a rigid pose by point-to-point ICP, as Graph-GSReg does."""

from __future__ import annotations

from dataclasses import dataclass

from gsmap.methods.refiner import Surface
from gsmap.register.refiners._small_gicp import align
from gsmap.types import Sim3

VERSION = 1
SCALES = False

_MAX_ITERATIONS = 50  # of each run


@dataclass(frozen=True)
class Params:
    """Point-to-point ICP (Besl and McKay 1992).

    Where scenes overlap in part, points beyond the overlap are pulled to its edge. The larger the correspondence
    distance, the more the pose drifts along walls and floors (in a room: 1.3 m at a distance of 0.35 m, 9 cm at 0.12
    m).

    Args:
        radii_m: Largest correspondence distance in metres, positive, of each run of ICP, from the coarse run to the
            fine one; larger values reach farther and drift more.
        means: Align the means of all surface Gaussians, as Graph-GSReg does, instead of their averages over cells.
    """

    radii_m: tuple[float, ...] = (0.12, 0.06)
    means: bool = False


def refine(
    target: Surface, source: Surface, start: Sim3, params: Params | None = None, *, with_scale: bool = False
) -> Sim3:
    """Align two surfaces (metres) by ICP on their cells' centres, or on all means (small_gicp).

    The scale of the start is kept. Returns the start where the overlap is too small.
    """
    params = params or Params()
    return align(
        "ICP",
        target,
        source,
        start,
        radii_m=params.radii_m,
        max_iterations=_MAX_ITERATIONS,
        every_point=params.means,
    )

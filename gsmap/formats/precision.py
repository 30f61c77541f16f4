"""Keep positions exact in single precision: subtract an origin from positions far from zero."""

from __future__ import annotations

import os
from collections.abc import Callable

import numpy as np

from gsmap.errors import InputError
from gsmap.geometry.origins import float32_step, is_float32, neighbour_distance, origin_of
from gsmap.stream import shift_origin
from gsmap.types import Gaussians, GaussianSource
from gsmap.types.source import gathered, origin_of_source

_SAMPLE = 20_000
_FINE = 100.0  # steps of a format between neighbours, at least: rounding then moves nothing that shows


def about_origin(where: str | os.PathLike[str], source: GaussianSource) -> GaussianSource:
    """Return the source with positions relative to an origin, if they lie too far from zero for float32.

    Args:
        where: Name of the source in messages.

    Raises:
        InputError: Positions were rounded to single precision before, and so coarsely that neighbours fall
            together.
    """
    origin = origin_of_source(source)
    if not origin.any():
        first = next(source.chunks(), None)
        if first is None or not origin_of(first.means).any():
            return source
        n = source.num_gaussians
        rows = np.unique(np.linspace(0, n - 1, min(n, _SAMPLE)).astype(np.int64))
        origin = origin_of(gathered(source, "means", rows))
        if not origin.any():
            return source
        source = shift_origin(source, origin)
    step = rounded_to(source)
    apart = neighbour_distance(source) if step else np.inf
    if apart <= 2 * step:
        raise InputError(
            f"{where}: near {format_origin(origin)}, single precision stores positions in steps of {step:g}, too "
            f"coarse for points {apart:.2g} apart: export it in double precision, or subtract {format_origin(origin)}",
            code="precision_loss",
        )
    return source


def rounded_to(source: GaussianSource) -> float:
    """Return the step to which single precision rounded the positions of a source with an origin; 0 if it did not."""
    first = next(source.chunks()).positions
    return float32_step(first) if is_float32(first) else 0.0


def about_zero(
    path: str | os.PathLike[str], gaussians: Gaussians, step_of: Callable[[np.ndarray], float] | None = None
) -> Gaussians:
    """Add the origin of Gaussians to their positions, for a format that stores at most single precision.

    Args:
        step_of: Function that returns the step of stored positions (N, 3); None for single precision.

    Raises:
        InputError: The format cannot represent the distances between neighbours at these positions.
    """
    positions = gaussians.positions
    step = (step_of or float32_step)(positions)
    is_exact = is_float32(positions) if step_of is None else not np.remainder(positions, step).any()
    apart = np.inf if is_exact else neighbour_distance(gaussians)
    if apart < _FINE * step:
        raise InputError(
            f"{path} cannot hold positions near {format_origin(gaussians.origin)}: it rounds them to {step:g} there, "
            f"and neighbours are {apart:.2g} apart: write .ply, .glb, .usdc or tileset.json, or take the offset "
            f"{format_origin(gaussians.origin)} off (gsmap convert --local)",
            code="precision_loss",
        )
    return gaussians.about(np.zeros(3))


def format_origin(origin: np.ndarray) -> str:
    """Format an origin for messages."""
    return "(" + ", ".join(f"{value:.15g}" for value in origin) + ")"

"""The compact form of a superseded capture."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Thinning:
    """Facts about a thinned capture, which keeps only rounded Gaussians visible in its own views, and no graph.

    Args:
        thinned_at: ISO 8601 time with zone.
        num_gaussians: number of Gaussians before.
        up: (3,) up direction in its frame by its former graph; or None.
    """

    thinned_at: str
    num_gaussians: int
    up: tuple[float, ...] | None = None

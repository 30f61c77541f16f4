"""How a capture is kept that newer ones supersede."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Thinning:
    """A capture that is kept compact: rounded Gaussians, those that its own pictures show, and no graph.

    Args:
        thinned_at: ISO 8601 time with zone.
        num_gaussians: Gaussians it had before.
        up: (3,) against gravity in its frame, as its graph said; or None.
    """

    thinned_at: str
    num_gaussians: int
    up: tuple[float, ...] | None = None

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
        has_row_map: its arrays tell which of its Gaussians are kept; false where an older gsmap thinned it.
    """

    thinned_at: str
    num_gaussians: int
    up: tuple[float, ...] | None = None
    has_row_map: bool = False

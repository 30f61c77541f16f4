"""When a placed photograph says that a thing is there, or gone."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Params:
    """When a placed photograph says something of a thing of the map.

    Args:
        on_m: what the map shows is the thing's where it lies so near to a sample of its surface.
        min_samples, min_share: samples, and share of them, that must be in sight for anything to be said.
        seen: share of what is in sight that must agree for the thing to be there.
        gone: share of what is in sight that must lie in a region that differs for it to be gone.
        same_place_m: what was said of a thing holds for the object whose box is so near to that place.
    """

    on_m: float = 0.12
    min_samples: int = 8
    min_share: float = 0.1
    seen: float = 0.6
    gone: float = 0.5
    same_place_m: float = 0.15

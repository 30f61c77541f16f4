"""A thing of the map, over all captures that show it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

SightingState = Literal["seen", "absent", "unseen"]
"""``seen``: it is there. ``absent``: the capture looked at or through its place, and it is not. ``unseen``: the capture
did not look there, which says nothing."""

SIGHTING_STATES: tuple[SightingState, ...] = ("seen", "absent", "unseen")


@dataclass(frozen=True, eq=False)
class Sighting:
    """What one capture says of an object.

    Args:
        scene: id of the capture.
        state: see `SightingState`.
        thing: of the capture's graph (`gsmap.types.Things`); -1 where it is none of its own there.
        box: (2, 3) float64 around it, the map's frame; None where it was not seen.
        looked: share of its place that the capture looked at or through; 1 where it shows the thing itself.
    """

    scene: str
    state: SightingState
    thing: int = -1
    box: np.ndarray | None = None
    looked: float = 1.0


@dataclass(frozen=True, eq=False)
class MapObject:
    """One thing, over all captures of its component.

    Args:
        id: 8 hex digits, of where its earliest capture shows it: captures that come later do not change it.
        component: of the map, whose frame positions and boxes are in.
        box: (2, 3) float64 around it where it was last seen.
        position: (3,) float64 mean of its Gaussians there.
        colour: (3,) float32 median, CIE L*a*b* (D65).
        sightings: one for each placed capture of the component, oldest first.
    """

    id: str
    component: int
    box: np.ndarray
    position: np.ndarray
    colour: np.ndarray
    sightings: tuple[Sighting, ...]

    @property
    def seen(self) -> int:
        """Captures that show it."""
        return sum(sighting.state == "seen" for sighting in self.sightings)

    @property
    def looks(self) -> int:
        """Captures that show it, or looked where it stood and do not."""
        return sum(sighting.state != "unseen" for sighting in self.sightings)

    @property
    def there(self) -> bool:
        """Whether the newest capture that looked at its place shows it."""
        return next((s.state == "seen" for s in reversed(self.sightings) if s.state != "unseen"), False)

"""A thing of the map, over all captures that show it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

SightingState = Literal["seen", "absent", "unseen"]
"""``seen``: it is there. ``absent``: the capture looked at or through its place, and it is not. ``unseen``: the capture
did not look there, which says nothing."""

SIGHTING_STATES: tuple[SightingState, ...] = ("seen", "absent", "unseen")

OBJECT_FACTS = ("name", "label", "note", "same_as")
"""What people say of an object."""


@dataclass(frozen=True, eq=False)
class Sighting:
    """What one capture says of an object.

    Args:
        scene: id of the capture.
        state: see `SightingState`.
        thing: of the capture's graph (`gsmap.types.Segments`); -1 where it is none of its own there.
        box: (2, 3) float64 around it, the map's frame; None where it was not seen.
        looked: share of its place that the capture looked at or through; 1 where it shows the thing itself.
        asked: id of the capture whose thing was looked for there; empty where none was, since the capture shows one of
            its own or a change says what became of it.
    """

    scene: str
    state: SightingState
    thing: int = -1
    box: np.ndarray | None = None
    looked: float = 1.0
    asked: str = ""


@dataclass(frozen=True)
class ObjectWords:
    """What people say of an object now; empty where nobody said anything.

    Args:
        name: what this one is called; no other object is called so.
        label: what kind of thing it is.
        note: the last one.
        same_as: id of the object that it is one with.
    """

    name: str = ""
    label: str = ""
    note: str = ""
    same_as: str = ""


@dataclass(frozen=True, eq=False)
class MapObject:
    """One thing, over all captures of its component.

    Args:
        id: what it is called (``o12``), also after the objects were made again; 8 hex digits, of where its earliest
            capture shows it, where it was not given a number.
        component: of the map, whose frame positions and boxes are in.
        box: (2, 3) float64 around it where it was last seen.
        position: (3,) float64 mean of its Gaussians there.
        colour: (3,) float32 median, CIE L*a*b* (D65).
        sightings: one for each placed capture of the component, oldest first.
        words: what people say of it.
    """

    id: str
    component: int
    box: np.ndarray
    position: np.ndarray
    colour: np.ndarray
    sightings: tuple[Sighting, ...]
    words: ObjectWords = ObjectWords()

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

"""A physical object of the map, tracked over captures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

ObservationState = Literal["seen", "absent", "unseen"]
"""``seen``: the capture shows the object. ``absent``: the capture shows the object's place without the object.
``unseen``: the capture does not show the place, so nothing is known.
"""

OBSERVATION_STATES: tuple[ObservationState, ...] = ("seen", "absent", "unseen")

OBJECT_FACTS = ("name", "label", "note", "same_as")
"""Kinds of annotations that a person can give an object."""


@dataclass(frozen=True, eq=False)
class ObjectObservation:
    """The observation of an object by one capture.

    Args:
        scene: capture id.
        state: see `ObservationState`.
        thing: segment in the capture's graph (`gsmap.types.Segments`); -1 if it has none.
        box: (2, 3) float64 box in the map frame; None if it was not seen.
        looked: fraction of its place that the capture observed; 1 if the capture has a segment of it.
        asked: id of the capture whose segment was looked for; empty if none was.
    """

    scene: str
    state: ObservationState
    thing: int = -1
    box: np.ndarray | None = None
    looked: float = 1.0
    asked: str = ""


@dataclass(frozen=True)
class ObjectAnnotations:
    """The current annotations of an object; an annotation that nobody gave is empty.

    Args:
        name: unique name.
        label: class label.
        note: newest note.
        same_as: id of the object that it is the same as.
    """

    name: str = ""
    label: str = ""
    note: str = ""
    same_as: str = ""


@dataclass(frozen=True, eq=False)
class MapObject:
    """An object of one component, over all captures.

    Args:
        id: lasting id (``o12``); without a number 8 hex digits derived from its earliest observation.
        component: component of the map, frame of positions and boxes.
        box: (2, 3) float64 box where it was last seen.
        position: (3,) float64 mean of its Gaussians there.
        colour: (3,) float32 median, CIE L*a*b* (D65).
        sightings: observations by the captures that looked at its place, oldest first; all other
            captures of the component did not see it.
        words: annotations.
        is_building: it is rather a part of the building, a room or debris (`gsmap.objects.building_parts`).
    """

    id: str
    component: int
    box: np.ndarray
    position: np.ndarray
    colour: np.ndarray
    sightings: tuple[ObjectObservation, ...]
    words: ObjectAnnotations = ObjectAnnotations()
    is_building: bool = False

    @property
    def seen(self) -> int:
        """Number of observations that show the object."""
        return sum(sighting.state == "seen" for sighting in self.sightings)

    @property
    def looks(self) -> int:
        """Number of observations that show the object or its absence."""
        return sum(sighting.state != "unseen" for sighting in self.sightings)

    @property
    def there(self) -> bool:
        """True if the newest observation of the object's place shows the object."""
        return next((s.state == "seen" for s in reversed(self.sightings) if s.state != "unseen"), False)

"""How long things stay."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise

import numpy as np

from gsmap.types import MapObject

_DAY_S = 86400.0


@dataclass(frozen=True)
class Permanence:
    """How permanent an object is, as far as it was looked for.

    Args:
        seen, looks: it was there in so many of so many looks at its place.
        half_life_days: after which half of such objects are gone; None where too few looks have dates.
    """

    seen: int
    looks: int
    half_life_days: float | None

    @property
    def share(self) -> float:
        """Of the looks."""
        return self.seen / self.looks if self.looks else 0.0


def permanence(thing: MapObject, dates: Mapping[str, str | None]) -> Permanence:
    """How often it was there, and how long such a thing stays.

    A thing goes at a constant rate (an exponential survival prior, as in Rosen, Mason and Leonard 2016, "Towards
    lifelong feature-based mapping in semi-static environments"). Between two looks it survived, or went half way
    between; the rate is the posterior mean under Jeffreys' prior, ``(departures + 1/2) / (time at risk)``, and the
    half-life ``ln 2`` over the rate: a thing that was never seen to go has the half-life that its time watched allows.

    Args:
        dates: when each capture was made, ISO 8601, by scene id; those without one do not count for the half-life.
    """
    looked = [
        (datetime.fromisoformat(when).timestamp() / _DAY_S, sighting.state == "seen")
        for sighting in thing.sightings
        if sighting.state != "unseen" and (when := dates.get(sighting.scene)) is not None
    ]
    looked.sort()
    at_risk, departures = 0.0, 0
    for (before, there), (after, still) in pairwise(looked):
        if there:
            at_risk += (after - before) * (1.0 if still else 0.5)
            departures += not still
    half_life = float(np.log(2) * at_risk / (departures + 0.5)) if at_risk > 0 else None
    return Permanence(thing.seen, thing.looks, half_life)

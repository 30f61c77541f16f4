"""Estimate how long objects stay in place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise

import numpy as np

from gsmap.types import MapObject

_DAY_S = 86400.0


@dataclass(frozen=True)
class Persistence:
    """Persistence of an object over its observations.

    Args:
        seen, looks: number of observations that show the object, and of all observations.
        half_life_days: number of days after which half of such objects are gone; None with too few dated observations.
    """

    seen: int
    looks: int
    half_life_days: float | None

    @property
    def share(self) -> float:
        """Fraction of the observations that show the object."""
        return self.seen / self.looks if self.looks else 0.0


def estimate_persistence(obj: MapObject, dates: Mapping[str, str | None]) -> Persistence:
    """Estimate the persistence of an object.

    Objects depart at a constant rate (an exponential survival prior, as in Rosen, Mason and Leonard 2016, "Towards
    lifelong feature-based mapping in semi-static environments"). Between two observations an object either survives or
    departs half-way. The rate is the posterior mean under Jeffreys' prior, ``(departures + 1/2) / (time at risk)``, and
    the half-life is ``ln 2`` divided by the rate. Without departures the half-life is limited by the observed time.

    Args:
        obj: the object.
        dates: ISO 8601 date of each scene, by its id; undated observations do not count for the half-life.
    """
    observed = [
        (datetime.fromisoformat(when).timestamp() / _DAY_S, sighting.state == "seen")
        for sighting in obj.sightings
        if sighting.state != "unseen" and (when := dates.get(sighting.scene)) is not None
    ]
    observed.sort()
    at_risk, departures = 0.0, 0
    for (before, there), (after, still) in pairwise(observed):
        if there:
            at_risk += (after - before) * (1.0 if still else 0.5)
            departures += not still
    half_life = float(np.log(2) * at_risk / (departures + 0.5)) if at_risk > 0 else None
    return Persistence(obj.seen, obj.looks, half_life)

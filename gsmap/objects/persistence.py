"""Estimation of how long objects stay in place."""

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
        seen, looks: numbers of observations that show it, and of all.
        half_life_days: days after which half of such objects are gone; None for too few dated observations.
    """

    seen: int
    looks: int
    half_life_days: float | None

    @property
    def share(self) -> float:
        """Fraction of the observations that show it."""
        return self.seen / self.looks if self.looks else 0.0


def estimate_persistence(obj: MapObject, dates: Mapping[str, str | None]) -> Persistence:
    """Estimate the persistence of an object.

    Objects depart at a constant rate (an exponential survival prior, as in Rosen, Mason and Leonard 2016, "Towards
    lifelong feature-based mapping in semi-static environments"). Between two observations an object survives, or
    departs half way between; the rate is the posterior mean under Jeffreys' prior, ``(departures + 1/2) / (time at
    risk)``, and the half-life ``ln 2`` over the rate. An object without departures has the half-life that its observed
    time permits.

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

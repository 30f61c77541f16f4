"""Detect changes between two captures of one place.

``compare(older, newer)`` is a pure function from two captures in one metric frame to a report. Differences of lighting,
exposure and coverage do not count as changes of objects.
"""

from __future__ import annotations

from gsmap.change.detection import VERSION, compare, recipe_key
from gsmap.change.params import Params

__all__ = ["VERSION", "Params", "compare", "recipe_key"]

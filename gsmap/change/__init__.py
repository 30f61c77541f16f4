"""Change detection between two captures of one place.

``compare(older, newer)`` is pure: two captures in one metric frame in, a report out. Different lighting, exposure and
coverage are no changes of objects.
"""

from __future__ import annotations

from gsmap.change.detection import VERSION, compare, recipe_key
from gsmap.change.params import Params

__all__ = ["VERSION", "Params", "compare", "recipe_key"]

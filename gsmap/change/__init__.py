"""What changed between two captures of one place.

``compare(older, newer)`` is pure: two captures in one metric frame in, a report out. Other light, another exposure, and
what one of the captures did not see are no changes of things.
"""

from __future__ import annotations

from gsmap.change.comparing import VERSION, compare, recipe_key
from gsmap.change.params import Params

__all__ = ["VERSION", "Params", "compare", "recipe_key"]

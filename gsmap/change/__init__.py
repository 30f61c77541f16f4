"""What changed between two captures of one place."""

from __future__ import annotations

from gsmap.change.comparing import VERSION, compare, recipe_key
from gsmap.change.params import Params

__all__ = ["VERSION", "Params", "compare", "recipe_key"]

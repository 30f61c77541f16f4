"""From a capture to its scene graph."""

from gsmap.describe.graph import Params, describe, recipe_key

__all__ = ["Params", "describe", "recipe_key"]

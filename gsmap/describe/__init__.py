"""Scene graphs of captures."""

from gsmap.describe.graph import Params, describe, recipe_key

__all__ = ["Params", "describe", "recipe_key"]

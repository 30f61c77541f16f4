"""Scene graphs of captures."""

from gsmap.describe.graph import GraphBasis, Params, describe, find_basis, recipe_key

__all__ = ["GraphBasis", "Params", "describe", "find_basis", "recipe_key"]

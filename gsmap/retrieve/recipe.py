"""Compute the recipes that name an index and its lookups."""

from __future__ import annotations

from gsmap.methods import RecipeKey
from gsmap.retrieve.lookup import VERSION
from gsmap.retrieve.params import Params
from gsmap.retrieve.scene_nodes import INDEX_VERSION


def index_recipe(params: Params) -> str:
    """Return the recipe that names the segments of an index."""
    return RecipeKey("retrieve", "index", {"index": INDEX_VERSION}, {"nodes_per_scene": params.nodes_per_scene}).recipe


def recipe_key(params: Params) -> RecipeKey:
    """Return the recipe of a lookup; the caller adds the key of the scene's graph as input."""
    settings = {"top_k": params.top_k, "nodes_per_scene": params.nodes_per_scene}
    return RecipeKey("retrieve", "lookup", {"retrieve": VERSION, "index": INDEX_VERSION}, settings)

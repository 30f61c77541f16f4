"""What names an index, and what it says of a scene."""

from __future__ import annotations

from gsmap.methods import RecipeKey
from gsmap.retrieve.lookup import VERSION
from gsmap.retrieve.params import Params
from gsmap.retrieve.voters import INDEX_VERSION


def index_recipe(params: Params) -> str:
    """What names the segments of an index: how nodes are kept, and how many of a scene."""
    return RecipeKey("retrieve", "index", {"index": INDEX_VERSION}, {"nodes_per_scene": params.nodes_per_scene}).recipe


def recipe_key(params: Params) -> RecipeKey:
    """The recipe of a lookup; its input, which the caller adds, is the key of the scene's graph."""
    settings = {"top_k": params.top_k, "nodes_per_scene": params.nodes_per_scene}
    return RecipeKey("retrieve", "lookup", {"retrieve": VERSION, "index": INDEX_VERSION}, settings)

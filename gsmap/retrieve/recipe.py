"""What names an index, and what it says of a scene."""

from __future__ import annotations

from dataclasses import fields

from gsmap.methods import RecipeKey
from gsmap.retrieve.lookup import VERSION
from gsmap.retrieve.params import Params
from gsmap.retrieve.voters import INDEX_VERSION
from gsmap.types.plain import plain

_NOT_ASKED = ("enough", "num_spatial", "reach_sigmas")  # of which pairs are tried, not of what is found


def index_recipe(params: Params) -> str:
    """What names the segments of an index: how nodes are kept, and how many of a scene."""
    return RecipeKey("retrieve", "index", {"index": INDEX_VERSION}, {"nodes_per_scene": params.nodes_per_scene}).recipe


def recipe_key(params: Params) -> RecipeKey:
    """The recipe of a lookup; its input, which the caller adds, is the key of the scene's graph."""
    settings = {f.name: plain(getattr(params, f.name)) for f in fields(params) if f.name not in _NOT_ASKED}
    return RecipeKey("retrieve", "lookup", {"retrieve": VERSION, "index": INDEX_VERSION}, settings)

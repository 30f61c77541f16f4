"""Retrieval: among many scenes find the pairs that may overlap."""

from gsmap.retrieve.index import new_segment
from gsmap.retrieve.lookup import VERSION, look_up
from gsmap.retrieve.neighbours import ScenePosition, neighbours
from gsmap.retrieve.pair_schedule import PairSchedule, directed
from gsmap.retrieve.params import Params
from gsmap.retrieve.recipe import index_recipe, recipe_key
from gsmap.retrieve.scene_nodes import SceneNodes, select_nodes

__all__ = [
    "VERSION",
    "Params",
    "ScenePosition",
    "PairSchedule",
    "SceneNodes",
    "directed",
    "index_recipe",
    "look_up",
    "neighbours",
    "new_segment",
    "recipe_key",
    "select_nodes",
]

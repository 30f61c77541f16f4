"""Retrieval: which of many scenes, views and objects are worth a closer look."""

from gsmap.retrieve.index import new_segment
from gsmap.retrieve.lookup import VERSION, look_up
from gsmap.retrieve.neighbours import Placed, neighbours
from gsmap.retrieve.pairs import candidate_pairs
from gsmap.retrieve.params import Params
from gsmap.retrieve.recipe import index_recipe, recipe_key
from gsmap.retrieve.rounds import Rounds, directed
from gsmap.retrieve.voters import Voters, voters_of

__all__ = [
    "VERSION",
    "Params",
    "Placed",
    "Rounds",
    "Voters",
    "candidate_pairs",
    "directed",
    "index_recipe",
    "look_up",
    "neighbours",
    "new_segment",
    "recipe_key",
    "voters_of",
]

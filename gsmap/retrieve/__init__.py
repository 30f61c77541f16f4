"""Retrieval: which of many scenes, views and objects are worth a closer look."""

from gsmap.retrieve.pairs import Params, Placed, candidate_pairs

__all__ = ["Params", "Placed", "candidate_pairs"]

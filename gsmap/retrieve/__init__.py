"""Retrieval: which of many scenes, views and objects are worth a closer look."""

from gsmap.retrieve.pairs import VERSION, Params, Placed, candidate_pairs

__all__ = ["VERSION", "Params", "Placed", "candidate_pairs"]

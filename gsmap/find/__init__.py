"""Find the objects of a map that are similar to a query, by geometry and colour or by embeddings."""

from gsmap.find.ranking import best_per_owner, cosine_similarities, rank_by_similarity
from gsmap.find.similarity import SegmentDescriptor, SimilarityModel, describe_samples, describe_segments

__all__ = [
    "SegmentDescriptor",
    "SimilarityModel",
    "best_per_owner",
    "cosine_similarities",
    "describe_samples",
    "describe_segments",
    "rank_by_similarity",
]

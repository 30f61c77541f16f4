"""Streams of Gaussians (`gsmap.types.GaussianSource`), whose memory is bounded by a chunk instead of a scene."""

from gsmap.stream.blocks import blocks, bounds, load_all, shift_origin
from gsmap.stream.infinities import clamp_column, clamp_infinities, count_clamped
from gsmap.stream.morton_sort import sorted_along_morton_curve

__all__ = [
    "shift_origin",
    "blocks",
    "bounds",
    "clamp_column",
    "clamp_infinities",
    "count_clamped",
    "load_all",
    "sorted_along_morton_curve",
]

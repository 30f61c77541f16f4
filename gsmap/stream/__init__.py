"""Streams of Gaussians (`gsmap.types.GaussianSource`): memory is bounded by a chunk, not by a scene."""

from gsmap.stream.infinities import clamped, clamped_column, num_clamped
from gsmap.stream.order import in_morton_order
from gsmap.stream.rows import about, blocks, bounds, loaded

__all__ = ["about", "blocks", "bounds", "clamped", "clamped_column", "in_morton_order", "loaded", "num_clamped"]

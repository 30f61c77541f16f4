"""Streams of Gaussians (`gsmap.types.GaussianSource`): memory is bounded by a chunk, not by a scene."""

from gsmap.stream.order import in_morton_order
from gsmap.stream.rows import about, blocks, bounds, loaded

__all__ = ["about", "blocks", "bounds", "in_morton_order", "loaded"]

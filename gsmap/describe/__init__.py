"""From a capture to its scene graph."""

from gsmap.describe.graph import DescribeParams, describe, methods

__all__ = ["DescribeParams", "describe", "methods"]

"""The version of gsmap and its name on the Python Package Index, which are defined here only."""

__version__ = "0.2.0"

DISTRIBUTION = "gsmapdb"
"""Name to install gsmap by. The names ``gsmap`` and ``gsmap3d`` belong to other projects on the index."""

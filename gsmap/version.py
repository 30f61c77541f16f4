"""The version of gsmap and its name on the Python Package Index, which are defined here only."""

__version__ = "1.0.0rc1"

DISTRIBUTION = "gsmapdb"
"""Name to install gsmap by. The names ``gsmap`` and ``gsmap3d`` belong to other projects on the index."""

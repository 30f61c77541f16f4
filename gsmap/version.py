"""The version of gsmap, which is defined here only."""

__version__ = "0.2.0"

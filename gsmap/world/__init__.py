"""Georeferencing: settings, and positions of photos; `gsmap.geodesy` converts coordinates.

The pose graph (`gsmap.optimize`) solves for the map's pose in the world.
"""

from __future__ import annotations

from gsmap.world.params import Params

__all__ = ["Params"]

"""Georeferencing: coordinate reference systems, the world frame, and positions of photos; pure functions.

`crs` and `frame` use PROJ to convert coordinates of any CRS exactly to metres in a Euclidean frame and back. `survey`
converts all observations of a map; `exif` reads the positions of photos. The pose graph (`gsmap.optimize`) solves for
the map's pose in the world. pyproj is imported on first use.
"""

from __future__ import annotations

from gsmap.world.params import Params

__all__ = ["Params"]

"""Georeferencing: coordinate reference systems, the world frame, and positions of photos; pure functions.

`crs` and `frame` convert coordinates of any CRS to metres of a Euclidean frame and back, exactly, by PROJ; `survey`
does so for all observations of a map; `exif` reads the positions of photos. The pose graph (`gsmap.optimize`) solves
for the map's pose in the world. pyproj loads on first use.
"""

from __future__ import annotations

from gsmap.world.params import Params

__all__ = ["Params"]

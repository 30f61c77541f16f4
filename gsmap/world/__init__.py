"""The world: coordinate reference systems, the world frame, and observations read from files; pure functions.

`crs` and `frame` turn coordinates of any CRS into metres of a Euclidean frame and back, point by point and exactly,
through PROJ; `survey` does so for all observations of a map; `exif` reads the positions of photos. Where the map lies
by them is solved in the pose graph (`gsmap.optimize`). pyproj loads on first use.
"""

from __future__ import annotations

from gsmap.world.params import Params

__all__ = ["Params"]

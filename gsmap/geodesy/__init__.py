"""Geodesy: coordinate reference systems and the world frame of a map; pure functions.

`crs` and `frame` use PROJ to convert coordinates of any CRS exactly to metres in a Euclidean frame and back. `survey`
converts all observations of a map. pyproj is imported on first use.
"""

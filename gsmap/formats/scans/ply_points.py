"""Read point clouds from a ``.ply`` of any numeric type, with the full precision of float64."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsmap.errors import InputError
from gsmap.formats import ply
from gsmap.formats.scans import limits
from gsmap.formats.scans.points import scan_of
from gsmap.types.scan import Scan

_COLOURS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))


def is_mesh(path: Path) -> bool:
    """Return true if the header has an element with faces."""
    elements = ply.read_header(path).elements
    return any(name in elements and elements[name].count for name in ("face", "tristrips"))


def read(path: Path) -> Scan:
    """Read the points of the element ``vertex``, with ``red green blue`` if the vertices have these properties.

    Raises:
        InputError: damaged, truncated, or vertices without ``x y z``.
    """
    header = ply.read_header(path)
    rows = ply.read_element(path, header, "vertex")
    names = set(rows.dtype.names or ())
    if not {"x", "y", "z"} <= names:
        raise InputError(f"{path} is not a point cloud: its vertices lack x, y or z", code="wrong_file_type")
    total = len(rows)
    rows = rows[:: -(-total // limits.MAX_POINTS)]
    points = np.stack([rows[axis].astype(np.float64) for axis in "xyz"], axis=1)
    colours = None
    for channels in _COLOURS:
        if names.issuperset(channels):
            kind = rows.dtype[channels[0]]
            most = float(np.iinfo(kind).max) if kind.kind in "iu" else 1.0
            colours = np.stack([rows[channel].astype(np.float64) / most for channel in channels], axis=1)
            colours = np.clip(np.nan_to_num(colours), 0.0, 1.0)
            break
    return scan_of(points, colours, path, total)

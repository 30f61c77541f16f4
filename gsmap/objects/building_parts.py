"""Tell movable objects from parts of the building by size, thickness, solidity, colour and outline.

Segments are what is left of a capture without floor, ceiling and walls. Beside furniture and things they include rooms
that could not be split, corners, door leaves, trims and patches of walls, which nobody looks for in a list of objects.
"""

from __future__ import annotations

import numpy as np

from gsmap.geometry.boxes import upright_box
from gsmap.objects.outlines import Outline

CELL_M = 0.08
"""Edge of the cells of the points, as in `gsmap.types.Segments`."""

_STRAYS = 0.03  # fraction of the points beyond each side of the box
_MAX_M = 3.0  # longer segments are several objects, or rooms
_MIN_M = 0.18  # smaller or narrower segments are trims and debris
_ROOM_M = 2.0  # from this height on the highest points are a ceiling
_AT_CEILING_M = 0.12  # segments that reach so near to the ceiling are walls and curtains, unless they hang from it
_HANGING = 0.75  # of the height of a room: segments above it hang from the ceiling
_TALL_M, _DEEP_M = 1.7, 0.3  # taller segments that are less deep are doors and remains of walls
_FLAT_M = 0.15  # segments that are less thick are flat: pictures, mirrors, doors, patches of walls
_OFF_FLOOR_M = 0.3  # flat segments that begin lower are doors, skirting boards and bits of the floor
_FLAT_AT_CEILING_M = 0.22  # flat segments that reach so near to the ceiling are windows and patches of walls
_MAX_FLAT_M = 2.0  # larger flat segments are patches of walls
_MAX_ASPECT = 3.0  # narrower flat segments are trims and curtain edges
_MIN_PATTERN = 25.0  # range of lightness of a flat segment that is no patch of a wall (CIE L*a*b*),
_MIN_TINTS = 12.0  # or its range of a* or b*
_MIN_SOLID = 0.35  # smallest fraction of the sides and the top of its box that a solid object covers,
_MIN_SOLID_TALL = 0.6  # and a tall one, since corners of rooms cover half of theirs
_MIN_SHOWN_PX = 30  # no view shows enough of a smaller segment to recognize it
_MIN_OUTLINE_PX = 20  # a shorter outline is no evidence
_MIN_FREE = 0.4  # an object stands out from what is behind it along at least this fraction of its outline, where that
# neither touches another surface nor is hidden by another segment
_MIN_OWN = 0.45  # smallest fraction of the outline of a flat object that stands out or touches another surface,
_MAX_HIDDEN = 0.33  # and largest fraction that is hidden: panes and niches lie behind the surface around them


def is_building_part(
    points: np.ndarray, lab: np.ndarray, floor_m: float, ceiling_m: float, outline: Outline | None = None
) -> bool:
    """Return whether a segment is rather a part of the building, a room or debris than an object.

    Args:
        points: (K, 3) samples of its surface in metres, z up, one per cell of `CELL_M`.
        lab: (K, 3) their colours, CIE L*a*b*.
        floor_m, ceiling_m: heights of the lowest and the highest surfaces of the scene's segments.
        outline: its outline in the views of its scene; None without views.
    """
    _, bounds = upright_box(points, np.array([0.0, 0.0, 1.0]), _STRAYS)
    length, width, height = bounds[1] - bounds[0]
    thickness, breadth, extent = principal_sizes(points)
    if outline is not None and _is_cut_out(outline, thickness < _FLAT_M):
        return True
    if max(length, height) > _MAX_M or extent < _MIN_M or breadth < _MIN_M:
        return True
    bottom, room = bounds[0, 2] - floor_m, ceiling_m - floor_m
    hangs = room >= _ROOM_M and bottom > _HANGING * room
    at_ceiling_m = _FLAT_AT_CEILING_M if thickness < _FLAT_M else _AT_CEILING_M
    if room >= _ROOM_M and not hangs and ceiling_m - bounds[1, 2] < at_ceiling_m:
        return True
    if height > _TALL_M and thickness < _DEEP_M:
        return True
    spread = np.ptp(np.percentile(lab, [10, 90], axis=0), axis=0)
    is_patterned = spread[0] >= _MIN_PATTERN or spread[1:].max() >= _MIN_TINTS
    if thickness < _FLAT_M:
        return bool(not is_patterned or bottom < _OFF_FLOOR_M or extent > _MAX_FLAT_M or extent > _MAX_ASPECT * breadth)
    sides = 2 * (length + width) * height + length * width
    return bool(len(points) * CELL_M**2 < (_MIN_SOLID_TALL if height > _TALL_M else _MIN_SOLID) * sides)


def _is_cut_out(outline: Outline, is_flat: bool) -> bool:
    """Return whether a segment is hardly shown, or was cut out of a surface that continues around or in front of it."""
    if outline.largest_px < _MIN_SHOWN_PX:
        return outline.largest_px > 0  # a segment that no view looks at may be anything
    hidden = outline.behind_building + outline.behind_segments
    whole = outline.free + outline.touching + outline.continuing + hidden
    stands_out = outline.free >= _MIN_FREE * (outline.free + outline.continuing + outline.behind_building)
    if whole < _MIN_OUTLINE_PX or outline.continuing + hidden == 0 or (outline.free and stands_out):
        return False
    own = outline.free + outline.touching
    return not is_flat or own < _MIN_OWN * whole or hidden > _MAX_HIDDEN * whole


def principal_sizes(points: np.ndarray) -> np.ndarray:
    """Return the (3,) sizes of points (K, 3) along their principal axes, ascending, as those of a uniform block."""
    off = points - points.mean(0)
    sizes: np.ndarray = np.sqrt(12 * np.maximum(np.linalg.eigvalsh(off.T @ off / max(len(off), 1)), 0))
    return sizes

"""Convert the survey observations of a map to its world frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from gsmap.errors import InputError
from gsmap.geodesy.crs import crs
from gsmap.geodesy.frame import frame_at, to_frame
from gsmap.types.world import LOCAL, ControlPoint, PositionFix, Survey, WorldFrame

_T = TypeVar("_T", ControlPoint, PositionFix)


def in_frame(survey: Survey) -> Survey:
    """Convert the positions of all observations to east, north, up in the world frame, for the solver.

    Raises:
        ConfigError, InputError: PROJ cannot convert a coordinate reference system or a coordinate.
    """
    if survey.frame is None:
        return replace(survey, points=(), images=(), fixes=())
    points = _moved(survey.frame, survey.points)
    fixes = _moved(survey.frame, survey.fixes)
    return replace(survey, points=tuple(points), fixes=tuple(fixes))


def frame_for(crs_text: str, survey: Survey) -> WorldFrame:
    """Return a world frame near the observations.

    Raises:
        InputError: no observation has a position.
    """
    system, found = crs(crs_text), []
    for group in _by_crs([*survey.points, *survey.fixes]).values():
        own = crs(group[0].crs)
        found.append(own.to_geodetic(np.array([one.position for one in group])))
    if not found:
        raise InputError(
            f"the map has no positions in {system.text} yet: add control points, photos with GNSS, or a scene position",
            code="not_georeferenced",
        )
    # Rounded to four digits of a degree, so the shift between datums does not matter.
    near = system.from_geodetic(np.median(np.concatenate(found), axis=0)[None])
    return frame_at(system.text, near)


def check_area(items: Sequence[ControlPoint | PositionFix], margin_deg: float) -> None:
    """Raise `InputError` for the first observation outside the area of use of its CRS."""
    for group in _by_crs(items).values():
        names = [f"control point {one.name}" if isinstance(one, ControlPoint) else one.name for one in group]
        crs(group[0].crs).check_area(np.array([one.position for one in group]), names, margin_deg)


def _by_crs(items: Sequence[ControlPoint | PositionFix]) -> dict[str, list[ControlPoint | PositionFix]]:
    found: dict[str, list[ControlPoint | PositionFix]] = {}
    for one in items:
        found.setdefault(one.crs, []).append(one)
    return found


def _moved(frame: WorldFrame, items: Sequence[_T]) -> list[_T]:
    out = list(items)
    places: dict[str, list[int]] = {}
    for k, one in enumerate(items):
        places.setdefault(one.crs, []).append(k)
    for text, rows in places.items():
        if text == LOCAL:
            continue
        metres = to_frame(frame, np.array([items[k].position for k in rows]), text)
        for k, position in zip(rows, metres, strict=True):
            out[k] = replace(items[k], crs=LOCAL, position=position)
    return out

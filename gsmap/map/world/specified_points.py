"""Parse points that the user specifies: in the map, in a scene, at a pixel of a camera, or in the world."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from gsmap.errors import ConfigError
from gsmap.map.world.pixel_points import picked_point
from gsmap.store import Store
from gsmap.world.params import DEPTH_SIGMA_FRACTION, PIXEL_SIGMA_PX

HOW = (
    "X,Y,Z (in the map), SCENE:X,Y,Z, SCENE:CAMERA@COLUMN,ROW (a pixel), or world:X,Y,Z (in the map's CRS; "
    "EPSG:N:X,Y,Z in another)"
)
_MAX_COORDINATE = 1e12  # far beyond any CRS, and its square is exact enough
_CRS = re.compile(r"(?i)(world|[a-z]+:\d+(?:\+\d+)?):([^:]*)")


@dataclass(frozen=True, eq=False)
class SpecifiedPoint:
    """A point that the user specified.

    Args:
        said: the text.
        point: (3,) in the frame of ``scene``, else of ``crs``, else of the map.
        covariance: (3, 3) covariance in that frame.
        scene: scene id; None for a point of the map or world.
        crs: CRS of a point of the world, ``world`` for the map's own; None for other points.
    """

    said: str
    point: np.ndarray
    covariance: np.ndarray
    scene: str | None = None
    crs: str | None = None


def parse_point(store: Store, text: str) -> SpecifiedPoint:
    """Parse a point in any of its forms.

    Raises:
        ConfigError: it is none of the ways to give one.
        NotFoundError: no such scene or camera, or nothing is to be seen at the pixel.
    """
    if (numbers := _numbers(text, 3)) is not None:
        return SpecifiedPoint(text, numbers, np.zeros((3, 3)))
    scene_name, colon, rest = text.rpartition(":")
    if (world := _CRS.fullmatch(text)) is not None and (numbers := _numbers(world[2], 3)) is not None:
        if world[1].lower() == "world" and any(scene.name == world[1] for scene in store.scenes.list()):
            raise ConfigError(
                f"a scene is called {world[1]}: name it by its id, or the world by its CRS, EPSG:N:X,Y,Z",
                code="scene_ambiguous",
            )
        return SpecifiedPoint(text, numbers, np.zeros((3, 3)), crs="world" if world[1].lower() == "world" else world[1])
    if colon and (numbers := _numbers(rest, 3)) is not None:
        return SpecifiedPoint(text, numbers, np.zeros((3, 3)), scene=store.scenes.get(scene_name).id)
    scene_name, colon, rest = text.partition(":")
    camera, at, pixel = rest.rpartition("@")
    if colon and at and (numbers := _numbers(pixel, 2)) is not None:
        scene = store.scenes.get(scene_name).id
        found = picked_point(store, scene, camera, numbers, DEPTH_SIGMA_FRACTION, PIXEL_SIGMA_PX)
        return SpecifiedPoint(text, *found, scene=scene)
    raise ConfigError(f"{text!r} is not a point: give {HOW}", code="invalid_point")


def parse_scene_point(store: Store, text: str) -> SpecifiedPoint:
    """Parse a point given in a scene, which moves with the scene when poses change."""
    found = parse_point(store, text)
    if found.scene is None:
        raise ConfigError(
            f"{text!r} is a point of the {'world' if found.crs else 'map'}, whose frame the solve moves: pick it in a "
            "scene, SCENE:X,Y,Z or SCENE:CAMERA@COLUMN,ROW",
            code="moving_frame",
        )
    return found


def _numbers(text: str, count: int) -> np.ndarray | None:
    try:
        found = np.array([float(part) for part in text.split(",")])
    except ValueError:
        return None
    if len(found) != count or not np.isfinite(found).all():
        return None
    if np.abs(found).max() > _MAX_COORDINATE:
        raise ConfigError(f"the coordinates of {text!r} exceed {_MAX_COORDINATE:g}", code="out_of_range")
    return found

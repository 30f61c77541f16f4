"""Georeference the components and the scenes of a revision."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsmap.errors import ConfigError
from gsmap.store import Store
from gsmap.types import PoseGraph, ScenePose, Sim3
from gsmap.types.plain import plain
from gsmap.types.world import WorldFrame

# Formats whose coordinates are float32: in a CRS, eight digits before the point would leave half a metre.
_IN_THE_FILE = ("3dtiles",)


@dataclass(frozen=True, eq=False)
class GeoreferencedComponent:
    """A component with a pose in the world.

    Args:
        frame: the world frame.
        S_world_map: component to world frame. S_ecef_map: to Earth-centred metres (EPSG:4978), or the error that there
            is no exact transformation.
    """

    frame: WorldFrame
    S_world_map: Sim3
    S_ecef_map: Sim3 | ConfigError

    def on_globe(self) -> Sim3:
        """Return ``S_ecef_map``.

        Raises:
            ConfigError: PROJ has no exact transformation to WGS 84.
        """
        if isinstance(self.S_ecef_map, ConfigError):
            raise self.S_ecef_map
        return self.S_ecef_map

    def to_json(self) -> dict[str, Any]:
        """Return the entry of ``tiles.json``, exact to the last bit."""
        out = {
            "crs": self.frame.crs,
            "origin": {k: v for k, v in plain(self.frame).items() if k != "crs"},
            "S_world_map": self.S_world_map.matrix().tolist(),
        }
        if isinstance(self.S_ecef_map, Sim3):
            out["S_ecef_map"] = self.S_ecef_map.matrix().tolist()
        return out


def georeferenced_components(graph: PoseGraph | None, components: Collection[int]) -> dict[int, GeoreferencedComponent]:
    """Return the components that have a pose in the world."""
    found = {}
    for tie in graph.world if graph is not None else ():
        if tie.component in components and tie.S_world_map is not None and tie.frame is not None:
            from gsmap.geodesy.frame import T_ecef_frame

            S_ecef_map: Sim3 | ConfigError
            try:
                S_ecef_map = T_ecef_frame(tie.frame) @ tie.S_world_map
            except ConfigError as error:
                S_ecef_map = error
            found[tie.component] = GeoreferencedComponent(tie.frame, tie.S_world_map, S_ecef_map)
    return found


def world_notes(found: Mapping[int, GeoreferencedComponent], format: str, up: str | None = "z") -> tuple[str, ...]:
    """Return notes on the coordinates of exported tiles.

    Args:
        up: vertical axis of the files.
    """
    if not found or format in _IN_THE_FILE:
        return ()
    named = ", ".join(sorted({one.frame.crs for one in found.values()}))
    turned = ", turned to x, -z, y" if up == "y" else ""
    if lacking := {str(one.S_ecef_map) for one in found.values() if isinstance(one.S_ecef_map, ConfigError)}:
        return (
            f"tiles of {format} are in the map's frame{turned}: tiles.json has S_world_map, which leads to {named}, "
            f"and no S_ecef_map: {'; '.join(sorted(lacking))}",
        )
    return (
        f"tiles of {format} are in the map's frame{turned}, since the format has no room for coordinates in {named}: "
        "tiles.json has S_world_map and S_ecef_map beside them; 3dtiles carries its place itself",
    )


def world_positions(
    store: Store, poses: Mapping[str, ScenePose], crs_text: str | None = None
) -> tuple[tuple[str, str] | None, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Return the CRS with its height reference, and each scene's origin: metres in the world frame, and in the CRS.

    Args:
        crs_text: another CRS than the map's.
    """
    ties = {tie.component: tie for tie in store.revisions.world() if tie.S_world_map is not None and tie.frame}
    if not ties:
        return None, {}
    from gsmap.geodesy.crs import crs
    from gsmap.geodesy.frame import from_frame

    found: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    named = None
    for component, tie in ties.items():
        assert tie.frame is not None
        assert tie.S_world_map is not None
        mine = [pose for pose in poses.values() if pose.component == component]
        named = crs_text or tie.frame.crs
        if mine:
            metric = tie.S_world_map.apply(np.array([pose.S_map_scene.translation for pose in mine]))
            world = from_frame(tie.frame, metric, named)
            found |= {pose.scene: (metric[k], world[k]) for k, pose in enumerate(mine)}
    return (None if named is None else (named, crs(named).heights)), found

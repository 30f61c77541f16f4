"""Where components of the poses lie in the world, for what leaves the map."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from gsmap.types import PoseGraph, Sim3
from gsmap.types.plain import plain
from gsmap.types.world import WorldFrame

# Formats whose coordinates are float32: in a CRS, eight digits before the point would leave half a metre.
_IN_THE_FILE = ("3dtiles",)


@dataclass(frozen=True, eq=False)
class InWorld:
    """A component that is tied to the world.

    Args:
        frame: the world frame.
        S_world_map: takes the component's frame to it. S_ecef_map: to Earth-centred metres (EPSG:4978).
    """

    frame: WorldFrame
    S_world_map: Sim3
    S_ecef_map: Sim3

    def told(self) -> dict[str, Any]:
        """As ``tiles.json`` has it: float64 to the last bit."""
        return {
            "crs": self.frame.crs,
            "origin": {k: v for k, v in plain(self.frame).items() if k != "crs"},
            "S_world_map": self.S_world_map.matrix().tolist(),
            "S_ecef_map": self.S_ecef_map.matrix().tolist(),
        }


def in_world(graph: PoseGraph | None, components: Collection[int]) -> dict[int, InWorld]:
    """Those of some components that are tied to the world."""
    found = {}
    for tie in graph.world if graph is not None else ():
        if tie.component in components and tie.S_world_map is not None and tie.frame is not None:
            from gsmap.world.frame import T_ecef_frame

            S_ecef_map = T_ecef_frame(tie.frame) @ tie.S_world_map
            found[tie.component] = InWorld(tie.frame, tie.S_world_map, S_ecef_map)
    return found


def world_notes(found: Mapping[int, InWorld], format: str) -> tuple[str, ...]:
    """What a person should know of where the tiles of a format are."""
    if not found or format in _IN_THE_FILE:
        return ()
    named = ", ".join(sorted({one.frame.crs for one in found.values()}))
    return (
        f"tiles of {format} are in the map's frame, since the format has no room for coordinates in {named}: "
        "tiles.json has S_world_map and S_ecef_map beside them; 3dtiles carries its place itself",
    )

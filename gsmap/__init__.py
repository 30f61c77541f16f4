"""gsmap: the map-management database for 3D Gaussian Splatting.

    with gsmap.open("site.gsmap") as m:
        m.ingest("monday.ply")
        m.update()
        m.export("tiles")

Everything public is listed in ``__all__`` and imported on first use, so ``import gsmap`` stays light.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from gsmap.version import __version__

_HOME = {
    "Cameras": "gsmap.types",
    "Edge": "gsmap.types",
    "Gaussians": "gsmap.types",
    "Map": "gsmap.map",
    "NodeLayer": "gsmap.types",
    "PoseGraph": "gsmap.types",
    "Prior": "gsmap.types",
    "Registration": "gsmap.types",
    "Scene": "gsmap.types",
    "SceneGraph": "gsmap.types",
    "ScenePose": "gsmap.types",
    "Sim3": "gsmap.types",
    "Tile": "gsmap.types",
    "errors": "",
    "map": "",
    "open": "gsmap.map",
    "read": "gsmap.formats",
    "render": "",
    "write": "gsmap.formats",
}

__all__ = [
    "Cameras",
    "Edge",
    "Gaussians",
    "Map",
    "NodeLayer",
    "PoseGraph",
    "Prior",
    "Registration",
    "Scene",
    "SceneGraph",
    "ScenePose",
    "Sim3",
    "Tile",
    "__version__",
    "errors",
    "map",
    "open",
    "read",
    "render",
    "write",
]

if TYPE_CHECKING:
    from gsmap import errors, map, render
    from gsmap.formats import read, write
    from gsmap.map import Map, open
    from gsmap.types import (
        Cameras,
        Edge,
        Gaussians,
        NodeLayer,
        PoseGraph,
        Prior,
        Registration,
        Scene,
        SceneGraph,
        ScenePose,
        Sim3,
        Tile,
    )


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'gsmap' has no attribute {name!r}")
    home = _HOME[name]
    value = getattr(importlib.import_module(home), name) if home else importlib.import_module(f"gsmap.{name}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__

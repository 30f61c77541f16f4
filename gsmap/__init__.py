"""gsmap: the map-management database for 3D Gaussian Splatting.

    with gsmap.open("site.gsmap") as m:
        m.ingest("monday.ply")
        m.update()
        m.export("tiles")

Everything public is listed in ``__all__`` and imported on first use, so ``import gsmap`` stays light; so are the rooms
of stages that can be used without a map (``gsmap.describe``, ``gsmap.register``, ...).
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from gsmap.version import __version__ as __version__

# The one list of what is public: where each name comes from. What type checkers are told below is held against it by
# a test.
_HOME = {
    "gsmap.formats": ("read", "write"),
    "gsmap.map": ("Map", "open"),
    "gsmap.types": (
        "Cameras",
        "Edge",
        "Gaussians",
        "NodeLayer",
        "PoseGraph",
        "Prior",
        "Registration",
        "Scene",
        "SceneGraph",
        "ScenePose",
        "Sim3",
        "Tile",
    ),
    "gsmap": ("errors", "map", "render"),
}
# Modules that are there without being in `__all__`.
_ROOMS = ("describe", "evaluate", "export", "formats", "merge", "optimize", "register", "store")

__all__ = sorted(["__version__", *(name for names in _HOME.values() for name in names)])

if TYPE_CHECKING:
    from gsmap import describe as describe
    from gsmap import errors as errors
    from gsmap import evaluate as evaluate
    from gsmap import export as export
    from gsmap import formats as formats
    from gsmap import map as map
    from gsmap import merge as merge
    from gsmap import optimize as optimize
    from gsmap import register as register
    from gsmap import render as render
    from gsmap import store as store
    from gsmap.formats import read as read
    from gsmap.formats import write as write
    from gsmap.map import Map as Map
    from gsmap.map import open as open
    from gsmap.types import Cameras as Cameras
    from gsmap.types import Edge as Edge
    from gsmap.types import Gaussians as Gaussians
    from gsmap.types import NodeLayer as NodeLayer
    from gsmap.types import PoseGraph as PoseGraph
    from gsmap.types import Prior as Prior
    from gsmap.types import Registration as Registration
    from gsmap.types import Scene as Scene
    from gsmap.types import SceneGraph as SceneGraph
    from gsmap.types import ScenePose as ScenePose
    from gsmap.types import Sim3 as Sim3
    from gsmap.types import Tile as Tile


def __getattr__(name: str) -> Any:
    home = next((home for home, names in _HOME.items() if name in names), "gsmap" if name in _ROOMS else None)
    if home is None:
        raise AttributeError(f"module 'gsmap' has no attribute {name!r}")
    module = importlib.import_module(f"gsmap.{name}" if home == "gsmap" else home)
    value = module if home == "gsmap" else getattr(module, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, *_ROOMS])

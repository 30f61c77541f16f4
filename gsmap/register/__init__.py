"""Pairwise registration: where one scene lies in another, and how sure that is."""

from gsmap.register.pair import METHOD_VERSION, Params, register_pair
from gsmap.register.scene_view import SceneView

__all__ = ["METHOD_VERSION", "Params", "SceneView", "register_pair"]

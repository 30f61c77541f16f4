"""Pairwise registration: where one scene lies in another, and how sure that is."""

from gsmap.register.pair import Params, register_pair
from gsmap.register.scene_view import SceneView

__all__ = ["Params", "SceneView", "register_pair"]

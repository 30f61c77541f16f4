"""Pairwise registration: the pose of one scene in another, with its uncertainty and a verdict."""

from gsmap.register.pair import check_pose, register_pair
from gsmap.register.params import Params
from gsmap.register.recipe import VERSION, recipe_key
from gsmap.register.scene_view import SceneView

__all__ = ["VERSION", "Params", "SceneView", "check_pose", "recipe_key", "register_pair"]

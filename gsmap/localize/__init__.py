"""Localize photos, video clips and scans in a map: retrieve views, estimate a pose, refine it and accept or reject
it."""

from gsmap.localize.clips import read_clip
from gsmap.localize.differences import CaptureViews, ChangedRegion, PhotoComparison, compare_photo, render_capture_views
from gsmap.localize.features import scene_features
from gsmap.localize.joint_localization import localize_together
from gsmap.localize.localization import localize_photo
from gsmap.localize.map_scene import MapScene
from gsmap.localize.panoramas import combine_faces
from gsmap.localize.params import Params
from gsmap.localize.photos import Lens, checked_model, photo_in_memory, read_photo
from gsmap.localize.recipe import recipe_key
from gsmap.localize.retrieval import ViewIndex, index_recipe, new_segment, view_index

__all__ = [
    "CaptureViews",
    "ChangedRegion",
    "Lens",
    "MapScene",
    "Params",
    "PhotoComparison",
    "ViewIndex",
    "checked_model",
    "combine_faces",
    "compare_photo",
    "index_recipe",
    "localize_photo",
    "localize_together",
    "new_segment",
    "read_clip",
    "photo_in_memory",
    "read_photo",
    "recipe_key",
    "render_capture_views",
    "scene_features",
    "view_index",
]

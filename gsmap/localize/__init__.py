"""Where a photograph, a clip or a scan was taken: found in the map, sharpened on it, and judged."""

from gsmap.localize.clips import read_clip
from gsmap.localize.differences import Differences, Eyes, Region, compare_photo, open_eyes
from gsmap.localize.features import scene_features
from gsmap.localize.localizing import localize_photo
from gsmap.localize.params import Params
from gsmap.localize.photos import Lens, read_photo
from gsmap.localize.placed import PlacedFeatures
from gsmap.localize.recipe import recipe_key
from gsmap.localize.retrieval import ViewIndex, index_recipe, new_segment, view_index
from gsmap.localize.together import localize_together

__all__ = [
    "Differences",
    "Eyes",
    "Lens",
    "Params",
    "PlacedFeatures",
    "Region",
    "ViewIndex",
    "compare_photo",
    "index_recipe",
    "localize_photo",
    "localize_together",
    "new_segment",
    "open_eyes",
    "read_clip",
    "read_photo",
    "recipe_key",
    "scene_features",
    "view_index",
]

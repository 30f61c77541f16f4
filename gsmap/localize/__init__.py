"""Where a photograph, a clip or a scan was taken: found in the map, sharpened on it, and judged."""

from gsmap.localize.features import scene_features
from gsmap.localize.localizing import localize_photo
from gsmap.localize.params import Params
from gsmap.localize.photos import Lens, read_photo
from gsmap.localize.placed import PlacedFeatures
from gsmap.localize.recipe import recipe_key
from gsmap.localize.retrieval import ViewIndex

__all__ = [
    "Lens",
    "Params",
    "PlacedFeatures",
    "ViewIndex",
    "localize_photo",
    "read_photo",
    "recipe_key",
    "scene_features",
]

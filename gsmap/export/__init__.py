"""Tiles of a map on disk: which there are, which must be made again, and writing them safely.

Pure but for the output folder: what a tile holds comes from a callable, so nothing here knows the store or a merger::

    plan = plan_tiles(poses, scene_bounds, tile_size_m=10.0, components=components, reach_m=gsmap.merge.reach_m(method))
    recipe = TileRecipe(gsmap.merge.recipe_key(method, params), format="spz", dates=dates)
    result = export_tiles(plan, make, out, map_id=map_id, recipe=recipe)

where ``make(planned, folder)(progress)`` returns `gsmap.merge.tile.merge_tile` of the scenes in ``planned.poses``
within ``planned.bounds``. Tiles are jobs: ``run=`` says where they are made.
"""

from gsmap.export.plan import Params, PlannedTile, plan_tiles
from gsmap.export.recipe import TileRecipe, dirty_reason
from gsmap.export.write import ExportResult, export_tiles

__all__ = ["ExportResult", "Params", "PlannedTile", "TileRecipe", "dirty_reason", "export_tiles", "plan_tiles"]

"""Export a map as tiles: plan them, update changed tiles only, and write crash-safely.

Independent of the store and of mergers: a callable makes the content of a tile::

    plan = plan_tiles(poses, scene_bounds, tile_size_m=10.0, components=components, reach_m=gsmap.merge.reach_m(method))
    recipe = TileRecipe(gsmap.merge.recipe_key(method, params), format="spz", dates=dates)
    result = export_tiles(plan, make, out, map_id=map_id, recipe=recipe)

where ``make(planned, folder)(progress)`` returns `gsmap.merge.tile.merge_tile` of the scenes in ``planned.poses``
within ``planned.bounds``. Tiles are jobs, which ``run=`` executes.
"""

from gsmap.export.plan import Params, PlannedTile, plan_tiles
from gsmap.export.recipe import TileRecipe, dirty_reason
from gsmap.export.write import ExportResult, export_tiles

__all__ = ["ExportResult", "Params", "PlannedTile", "TileRecipe", "dirty_reason", "export_tiles", "plan_tiles"]

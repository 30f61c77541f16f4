"""Read typed rows (`gsmap.types.rows`) from the store."""

from gsmap.map.reports.common import checked_pair, names, pair_of, scenes_by_id
from gsmap.map.reports.notebook import map_html
from gsmap.map.reports.one_scene import graph_row, prior_row, scene_report
from gsmap.map.reports.pairs import EDGE_STATUSES, edge_row, edge_rows, pair_report, rows_of_edges
from gsmap.map.reports.revisions import (
    history_position,
    made_after,
    pose_change_rows,
    revision_row,
    revision_rows,
    update_report,
)
from gsmap.map.reports.scenes import SCENE_STATUSES, ingest_row, pose_rows, scene_row, scene_rows
from gsmap.map.reports.upkeep import export_report, model_rows, setting_rows, tile_rows

__all__ = [
    "EDGE_STATUSES",
    "SCENE_STATUSES",
    "checked_pair",
    "edge_row",
    "edge_rows",
    "export_report",
    "graph_row",
    "ingest_row",
    "made_after",
    "map_html",
    "history_position",
    "model_rows",
    "names",
    "pair_of",
    "pair_report",
    "pose_change_rows",
    "pose_rows",
    "prior_row",
    "revision_row",
    "revision_rows",
    "rows_of_edges",
    "scene_report",
    "scene_row",
    "scene_rows",
    "scenes_by_id",
    "setting_rows",
    "tile_rows",
    "update_report",
]

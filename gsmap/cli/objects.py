"""JSON object that each verb prints with ``--json``, ``schema`` first; docs/reference/json.md is generated from it."""

from __future__ import annotations

import importlib
from dataclasses import dataclass

from gsmap.types.rows.base import Row

RowType = type[Row]


def _row_type(row: str) -> RowType:
    """Import a row class by its module in `gsmap.types.rows`: a verb loads only the row classes that it prints."""
    module, name = row.split(".")
    found: RowType = getattr(importlib.import_module(f"gsmap.types.rows.{module}"), name)
    return found


@dataclass(frozen=True)
class OneRow:
    """A JSON object with ``schema`` and the fields of one row or report."""

    row: str

    @property
    def type(self) -> RowType:
        return _row_type(self.row)


@dataclass(frozen=True)
class _KeyedRow:
    key: str
    row: str

    @property
    def type(self) -> RowType:
        return _row_type(self.row)


class ManyRows(_KeyedRow):
    """A JSON object with ``schema`` and, under a key, a list of rows."""


class OptionalRow(_KeyedRow):
    """A JSON object with ``schema`` and, under a key, a row or null."""


Object = OneRow | ManyRows | OptionalRow

OBJECTS: dict[str, Object] = {
    "init": OneRow("maps.InitReport"),
    "ingest": ManyRows("ingested", "scenes.IngestRow"),
    "describe": ManyRows("graphs", "scenes.GraphRow"),
    "register": ManyRows("edges", "pairs.EdgeRow"),
    "optimize": OneRow("revisions.RevisionRow"),
    "update": OneRow("revisions.UpdateReport"),
    "status": OneRow("maps.MapStatus"),
    "confirm": OneRow("pairs.EdgeRow"),
    "reject": OneRow("pairs.EdgeRow"),
    "confirm CHANGE": OneRow("changes.ChangeRow"),
    "reject CHANGE": OneRow("changes.ChangeRow"),
    "edge": OneRow("pairs.EdgeRow"),
    "prior": OptionalRow("prior", "scenes.PriorRow"),
    "changes": OneRow("changes.ChangesReport"),
    "graph": OneRow("objects.ObjectsReport"),
    "history": OneRow("objects.HistoryReport"),
    "localize": OneRow("localize.LocalizeReport"),
    "find": OneRow("find.FindReport"),
    "edit": OneRow("scenes.SceneRow"),
    "edit OBJECT": OneRow("objects.ObjectRow"),
    "export": OneRow("exports.ExportReport"),
    "export --for": OneRow("exports.SmallMapReport"),
    "list scenes": ManyRows("scenes", "scenes.SceneRow"),
    "list edges": ManyRows("edges", "pairs.EdgeRow"),
    "list revisions": ManyRows("revisions", "revisions.RevisionRow"),
    "list tiles": ManyRows("tiles", "exports.TileRow"),
    "list photos": ManyRows("photos", "localize.PhotoRow"),
    "show SCENE": OneRow("scenes.SceneReport"),
    "show A:B": OneRow("pairs.PairReport"),
    "show CHANGE": OneRow("changes.ChangeDetail"),
    "show OBJECT": OneRow("objects.HistoryReport"),
    "why A:B": OneRow("pairs.PairExplanation"),
    "diff": ManyRows("scenes", "revisions.PoseChangeRow"),
    "poses": ManyRows("poses", "scenes.PoseRow"),
    "georeference": OneRow("world.WorldReport"),
    "measure": OneRow("world.MeasureReport"),
    "settings": ManyRows("settings", "maps.SettingRow"),
    "convert": OneRow("maps.ConvertReport"),
    "clean": OneRow("maps.CleanReport"),
    "models add": OneRow("maps.ModelRow"),
    "models list": ManyRows("models", "maps.ModelRow"),
    "evaluate": OneRow("evaluation.EvaluationReport"),
    "branch": ManyRows("branches", "map_operations.BranchRow"),
    "tag": ManyRows("tags", "map_operations.BranchRow"),
    "merge": OneRow("map_operations.MergeReport"),
    "split": OneRow("map_operations.SplitReport"),
    "remove": OneRow("scenes.SceneRow"),
    "remove --purge": OneRow("map_operations.PurgeReport"),
    "remove --photo": OneRow("localize.PhotoRow"),
    "restore-scene": OneRow("scenes.SceneRow"),
    "check": OneRow("maps.CheckReport"),
    "prune": OneRow("maps.PruneReport"),
    "thin": OneRow("thinning.ThinReport"),
    "migrate": OneRow("maps.MigrateReport"),
    "backup": OneRow("backups.BackupReport"),
    "backup --list": ManyRows("snapshots", "backups.SnapshotRow"),
    "restore": OneRow("backups.RestoreReport"),
    "clone": OneRow("backups.CloneReport"),
    "report": OneRow("reports.WrittenReport"),
    "trust": OneRow("trust.TrustReport"),
    "view": OneRow("maps.ViewReport"),
    "demo": OneRow("demo.DemoReport"),
}
"""JSON object by verb; verbs with several forms have one entry per form."""

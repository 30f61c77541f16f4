"""JSON object that each verb prints with ``--json``, ``schema`` first; docs/reference/json.md is generated from it."""

from __future__ import annotations

from dataclasses import dataclass

from gsmap.types import rows
from gsmap.types.rows import Row


@dataclass(frozen=True)
class OneRow:
    """The fields of one row or report beside ``schema``."""

    type: type[Row]


@dataclass(frozen=True)
class ManyRows:
    """A list of rows under a key beside ``schema``."""

    key: str
    type: type[Row]


@dataclass(frozen=True)
class OptionalRow:
    """A row, or null, under a key beside ``schema``."""

    key: str
    type: type[Row]


Object = OneRow | ManyRows | OptionalRow

OBJECTS: dict[str, Object] = {
    "init": OneRow(rows.InitReport),
    "ingest": ManyRows("ingested", rows.IngestRow),
    "describe": ManyRows("graphs", rows.GraphRow),
    "register": ManyRows("edges", rows.EdgeRow),
    "optimize": OneRow(rows.RevisionRow),
    "update": OneRow(rows.UpdateReport),
    "status": OneRow(rows.MapStatus),
    "confirm": OneRow(rows.EdgeRow),
    "reject": OneRow(rows.EdgeRow),
    "confirm CHANGE": OneRow(rows.ChangeRow),
    "reject CHANGE": OneRow(rows.ChangeRow),
    "edge": OneRow(rows.EdgeRow),
    "prior": OptionalRow("prior", rows.PriorRow),
    "changes": OneRow(rows.ChangesReport),
    "graph": OneRow(rows.ObjectsReport),
    "history": OneRow(rows.HistoryReport),
    "localize": OneRow(rows.LocalizeReport),
    "find": OneRow(rows.FindReport),
    "edit": OneRow(rows.SceneRow),
    "edit OBJECT": OneRow(rows.ObjectRow),
    "export": OneRow(rows.ExportReport),
    "export --for": OneRow(rows.SmallMapReport),
    "list scenes": ManyRows("scenes", rows.SceneRow),
    "list edges": ManyRows("edges", rows.EdgeRow),
    "list revisions": ManyRows("revisions", rows.RevisionRow),
    "list tiles": ManyRows("tiles", rows.TileRow),
    "list photos": ManyRows("photos", rows.PhotoRow),
    "show SCENE": OneRow(rows.SceneReport),
    "show A:B": OneRow(rows.PairReport),
    "show CHANGE": OneRow(rows.ChangeDetail),
    "why A:B": OneRow(rows.PairExplanation),
    "diff": ManyRows("scenes", rows.PoseChangeRow),
    "poses": ManyRows("poses", rows.PoseRow),
    "georeference": OneRow(rows.WorldReport),
    "measure": OneRow(rows.MeasureReport),
    "settings": ManyRows("settings", rows.SettingRow),
    "convert": OneRow(rows.ConvertReport),
    "models add": OneRow(rows.ModelRow),
    "models list": ManyRows("models", rows.ModelRow),
    "evaluate": OneRow(rows.EvaluationReport),
    "branch": ManyRows("branches", rows.BranchRow),
    "tag": ManyRows("tags", rows.BranchRow),
    "merge": OneRow(rows.MergeReport),
    "split": OneRow(rows.SplitReport),
    "remove": OneRow(rows.SceneRow),
    "remove --purge": OneRow(rows.PurgeReport),
    "remove --photo": OneRow(rows.PhotoRow),
    "restore-scene": OneRow(rows.SceneRow),
    "check": OneRow(rows.CheckReport),
    "prune": OneRow(rows.PruneReport),
    "thin": OneRow(rows.ThinReport),
    "migrate": OneRow(rows.MigrateReport),
    "backup": OneRow(rows.BackupReport),
    "backup --list": ManyRows("snapshots", rows.SnapshotRow),
    "restore": OneRow(rows.RestoreReport),
    "clone": OneRow(rows.CloneReport),
    "report": OneRow(rows.WrittenReport),
    "trust": OneRow(rows.TrustReport),
    "view": OneRow(rows.ViewReport),
    "demo": OneRow(rows.DemoReport),
}
"""JSON object by verb; verbs with several forms have one entry per form."""

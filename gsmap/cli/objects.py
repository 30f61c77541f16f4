"""JSON object that each verb prints with ``--json``, ``schema`` first; docs/reference/json.md is generated from it."""

from __future__ import annotations

from dataclasses import dataclass

from gsmap.types import rows
from gsmap.types.rows import Row


@dataclass(frozen=True)
class One:
    """The fields of one row or report beside ``schema``."""

    type: type[Row]


@dataclass(frozen=True)
class Many:
    """A list of rows under a key beside ``schema``."""

    key: str
    type: type[Row]


@dataclass(frozen=True)
class Maybe:
    """A row, or null, under a key beside ``schema``."""

    key: str
    type: type[Row]


Object = One | Many | Maybe

OBJECTS: dict[str, Object] = {
    "init": One(rows.InitReport),
    "ingest": Many("ingested", rows.IngestRow),
    "describe": Many("graphs", rows.GraphRow),
    "register": Many("edges", rows.EdgeRow),
    "optimize": One(rows.RevisionRow),
    "update": One(rows.UpdateReport),
    "status": One(rows.MapStatus),
    "confirm": One(rows.EdgeRow),
    "reject": One(rows.EdgeRow),
    "confirm CHANGE": One(rows.ChangeRow),
    "reject CHANGE": One(rows.ChangeRow),
    "edge": One(rows.EdgeRow),
    "prior": Maybe("prior", rows.PriorRow),
    "changes": One(rows.ChangesReport),
    "graph": One(rows.ObjectsReport),
    "history": One(rows.HistoryReport),
    "localize": One(rows.LocalizeReport),
    "find": One(rows.FindReport),
    "edit": One(rows.SceneRow),
    "edit OBJECT": One(rows.ObjectRow),
    "export": One(rows.ExportReport),
    "export --for": One(rows.SmallMapReport),
    "list scenes": Many("scenes", rows.SceneRow),
    "list edges": Many("edges", rows.EdgeRow),
    "list revisions": Many("revisions", rows.RevisionRow),
    "list tiles": Many("tiles", rows.TileRow),
    "list photos": Many("photos", rows.PhotoRow),
    "show SCENE": One(rows.SceneReport),
    "show A:B": One(rows.PairReport),
    "show CHANGE": One(rows.ChangeDetail),
    "why A:B": One(rows.PairExplanation),
    "diff": Many("scenes", rows.PoseChangeRow),
    "poses": Many("poses", rows.PoseRow),
    "georeference": One(rows.WorldReport),
    "measure": One(rows.MeasureReport),
    "settings": Many("settings", rows.SettingRow),
    "convert": One(rows.ConvertReport),
    "models add": One(rows.ModelRow),
    "models list": Many("models", rows.ModelRow),
    "evaluate": One(rows.EvaluationReport),
    "branch": Many("branches", rows.BranchRow),
    "tag": Many("tags", rows.BranchRow),
    "merge": One(rows.MergeReport),
    "split": One(rows.SplitReport),
    "remove": One(rows.SceneRow),
    "remove --purge": One(rows.PurgeReport),
    "remove --photo": One(rows.PhotoRow),
    "restore-scene": One(rows.SceneRow),
    "check": One(rows.CheckReport),
    "prune": One(rows.PruneReport),
    "thin": One(rows.ThinReport),
    "migrate": One(rows.MigrateReport),
    "backup": One(rows.BackupReport),
    "backup --list": Many("snapshots", rows.SnapshotRow),
    "restore": One(rows.RestoreReport),
    "clone": One(rows.CloneReport),
    "report": One(rows.WrittenReport),
    "trust": One(rows.TrustReport),
    "view": One(rows.ViewReport),
    "demo": One(rows.DemoReport),
}
"""By verb, with what tells its forms apart."""

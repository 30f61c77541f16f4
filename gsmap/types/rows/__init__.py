"""Rows and reports: one frozen dataclass for everything that a map returns.

Each is defined once. Its fields are what Python reads and, by the same names, the keys of the JSON that ``--json``
prints; ``columns`` says which of them a table shows, and under which headings; ``Args:`` says what each means
(docs/reference/json.md is generated from it).

Ids and names go together under the same keys everywhere: ``scene`` and ``scene_name``, ``target`` and ``target_name``,
``source`` and ``source_name``. Only `SceneRow`, which is the scene, calls them ``id`` and ``name``.
"""

from gsmap.types.rows.backups import BackupReport, CloneReport, RestoreReport, SnapshotRow
from gsmap.types.rows.base import SCHEMA, Row, Table
from gsmap.types.rows.changes import ChangeDetail, ChangeRow, ChangesReport, ComparisonRow
from gsmap.types.rows.evaluation import (
    BandRow,
    ComponentErrorRow,
    EdgeErrorRow,
    EvaluationReport,
    ImageErrorRow,
    NeesRow,
    PoseErrorRow,
)
from gsmap.types.rows.exports import ExportReport, SmallMapReport, SmallSceneRow, TileRow
from gsmap.types.rows.find import FindHit, FindReport
from gsmap.types.rows.leases import LeaseRow
from gsmap.types.rows.localize import LocalizeReport, LocalizeRow, PhotoChangeRow, PhotoRow
from gsmap.types.rows.map_operations import BranchRow, MergeReport, PurgeReport, SplitReport
from gsmap.types.rows.maps import (
    CheckReport,
    ConvertReport,
    DemoReport,
    InitReport,
    MapStatus,
    MetricScaleRow,
    MigrateReport,
    ModelRow,
    PruneReport,
    SettingRow,
    TodoRow,
    ViewReport,
)
from gsmap.types.rows.objects import (
    HistoryReport,
    ObjectFactRow,
    ObjectObservationRow,
    ObjectRow,
    ObjectsReport,
    RelationRow,
    RoomRow,
)
from gsmap.types.rows.pairs import EdgeRow, ExplanationStep, PairEventRow, PairExplanation, PairRef, PairReport
from gsmap.types.rows.reports import WrittenReport
from gsmap.types.rows.revisions import PoseChangeRow, RevisionRow, UpdateReport
from gsmap.types.rows.scenes import (
    FactRow,
    GraphRow,
    IngestRow,
    LayerRow,
    NodeRow,
    PoseRow,
    PriorRow,
    SceneEdgeRow,
    SceneRef,
    SceneReport,
    SceneRow,
)
from gsmap.types.rows.thinning import ThinReport, ThinRow
from gsmap.types.rows.trust import TrustReport
from gsmap.types.rows.world import ContradictionRow, GeoreferenceRow, MeasureReport, PointRow, ResidualRow, WorldReport

__all__ = [
    "SCHEMA",
    "LeaseRow",
    "BackupReport",
    "BandRow",
    "BranchRow",
    "ChangeDetail",
    "ChangeRow",
    "ChangesReport",
    "CheckReport",
    "CloneReport",
    "ComparisonRow",
    "ComponentErrorRow",
    "ContradictionRow",
    "ConvertReport",
    "DemoReport",
    "EdgeErrorRow",
    "EdgeRow",
    "EvaluationReport",
    "ExportReport",
    "FactRow",
    "FindHit",
    "FindReport",
    "GraphRow",
    "HistoryReport",
    "ImageErrorRow",
    "IngestRow",
    "InitReport",
    "LayerRow",
    "LocalizeReport",
    "LocalizeRow",
    "PhotoChangeRow",
    "PhotoRow",
    "MapStatus",
    "MeasureReport",
    "MergeReport",
    "MetricScaleRow",
    "MigrateReport",
    "ModelRow",
    "NeesRow",
    "NodeRow",
    "ObjectFactRow",
    "ObjectRow",
    "ObjectsReport",
    "PairEventRow",
    "PairRef",
    "PairReport",
    "PointRow",
    "PoseChangeRow",
    "PoseErrorRow",
    "PoseRow",
    "PriorRow",
    "PruneReport",
    "PurgeReport",
    "RelationRow",
    "ResidualRow",
    "RestoreReport",
    "RevisionRow",
    "Row",
    "SceneEdgeRow",
    "SceneRef",
    "RoomRow",
    "SceneReport",
    "SceneRow",
    "SettingRow",
    "ObjectObservationRow",
    "SnapshotRow",
    "SplitReport",
    "Table",
    "ThinReport",
    "ThinRow",
    "GeoreferenceRow",
    "SmallMapReport",
    "SmallSceneRow",
    "TileRow",
    "TodoRow",
    "TrustReport",
    "UpdateReport",
    "ViewReport",
    "PairExplanation",
    "ExplanationStep",
    "WrittenReport",
    "WorldReport",
]

"""The content of a report: rows that verbs print as well, and data for the drawings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from gsmap.report.params import Params
from gsmap.report.plan import Plan
from gsmap.types.metric_scale import MetricScale
from gsmap.types.rows.changes import ChangesReport
from gsmap.types.rows.maps import MapStatus
from gsmap.types.rows.objects import ObjectsReport
from gsmap.types.rows.pairs import EdgeRow
from gsmap.types.rows.revisions import PoseChangeRow, RevisionRow
from gsmap.types.rows.scenes import SceneRow

CHI2_DOF = 7
"""Degrees of freedom of an edge: three of rotation, three of translation, one of scale."""

CHI2_95, CHI2_999 = 14.067, 24.322
"""Quantiles of the chi-square distribution with 7 degrees of freedom: 95 % and 99.9 %."""


@dataclass(frozen=True, eq=False)
class SceneEntry:
    """A scene of the report, with the uncertainty of its pose.

    Args:
        row: Row of the scene as in `gsmap list`.
        num_bytes: Size of the stored arrays.
        position_sigma_m: Standard deviation of the centre of its cameras, or of its Gaussians if it has no cameras, in
            the least certain direction, metres; None if unknown.
        rotation_sigma_deg: Largest standard deviation of the rotation; None if unknown.
    """

    row: SceneRow
    num_bytes: int = 0
    position_sigma_m: float | None = None
    rotation_sigma_deg: float | None = None


@dataclass(frozen=True, eq=False)
class EdgeEntry:
    """An edge of the report, with its residual under the newest poses.

    Args:
        row: Row of the edge as in `gsmap list`.
        chi2: Chi-square of the residual, `CHI2_DOF` degrees of freedom; None if there is no residual.
        translation_m: Translation residual at the centre of the source; None if the scenes share no component.
        rotation_deg: Rotation residual; None if the scenes share no component.
        probability: Probability that the pose is right (`gsmap.types.Registration`); None if unknown.
        component: Common component of both scenes; None if they share none.
    """

    row: EdgeRow
    chi2: float | None = None
    translation_m: float | None = None
    rotation_deg: float | None = None
    probability: float | None = None
    component: int | None = None

    @property
    def use(self) -> str:
        """The use of the row, with ``tentative`` for ``one pair``, or the status of an edge that is not accepted."""
        use = self.row.use or self.row.status
        return "tentative" if use == "one pair" else use

    @property
    def kind(self) -> str:
        """``strained`` for a used edge whose residual only one in a thousand correct edges exceeds, else its use."""
        return "strained" if self.use == "used" and (self.chi2 or 0.0) > CHI2_999 else self.use

    @property
    def doubt(self) -> float:
        """Urgency of a review in [0, 1]: undecided edges first, then edges that no cycle confirms, edges with residuals
        beyond their covariance, and excluded edges; within each group the less probable first. 0 after a review."""
        if self.row.review is not None:
            return 0.0
        unlikely = 1.0 - min(1.0, max(0.0, self.probability or 0.0))
        low = {"undecided": 0.8, "tentative": 0.6, "strained": 0.4, "unused": 0.2}.get(self.kind)
        return 0.0 if low is None else low + 0.19 * unlikely


@dataclass(frozen=True, eq=False)
class Island:
    """A component of the newest poses.

    Args:
        component: Index of the component.
        scenes: Names of its scenes.
        metre: Metric scale of the component frame.
        plan: Floor plan; None if it is not drawn.
        note: Note on the plan, or the reason why there is none; may be empty.
    """

    component: int
    scenes: tuple[str, ...]
    metre: MetricScale
    plan: Plan | None = None
    note: str = ""


@dataclass(frozen=True, eq=False)
class PoseDifferences:
    """Differences of the scene poses between a revision and an earlier revision."""

    before: int
    after: int
    rows: tuple[PoseChangeRow, ...]


@dataclass(frozen=True, eq=False)
class Report:
    """Content of a report of a map.

    Args:
        title: Name of the map.
        map_id: Id of the map.
        made_at: Date of the report, ISO 8601 with zone.
        version: Version of gsmap.
        status: Status of the map with its open tasks.
        scenes: Scenes that are not removed, oldest first.
        edges: Current edge of every registered pair.
        islands: Components, largest first.
        revisions: The newest revisions, oldest first.
        num_revisions: Number of all revisions.
        moved: Pose differences between each revision and the previous one, newest first.
        since: Date from which additions are reported, ISO 8601; None for no such date.
        moved_since: Pose differences between the newest revision and the last one before ``since``; None without such
            a revision or date.
        new_scenes: Names of the scenes ingested after ``since``.
        new_edges: Edges of the pairs registered after ``since``.
        changes: Changes between scenes; None if there are no poses.
        objects: Stored objects and rooms; None if there are none.
        pair_pictures: Pictures (H, W, 3) uint8 of both captures of doubtful edges, by the ids of their scenes.
        change_pictures: Pictures (H, W, 3) uint8 before and after changes, by id.
        storage: Number and bytes of stored data by kind, largest first.
        seconds: Wall-clock seconds of registration by step.
        notes: Notes on the report itself.
        params: Settings that bound the size of the report.
    """

    title: str
    map_id: str
    made_at: str
    version: str
    status: MapStatus
    scenes: tuple[SceneEntry, ...] = ()
    edges: tuple[EdgeEntry, ...] = ()
    islands: tuple[Island, ...] = ()
    revisions: tuple[RevisionRow, ...] = ()
    num_revisions: int = 0
    moved: tuple[PoseDifferences, ...] = ()
    since: str | None = None
    moved_since: PoseDifferences | None = None
    new_scenes: tuple[str, ...] = ()
    new_edges: tuple[EdgeRow, ...] = ()
    changes: ChangesReport | None = None
    objects: ObjectsReport | None = None
    pair_pictures: Mapping[tuple[str, str], np.ndarray] = field(default_factory=dict)
    change_pictures: Mapping[str, np.ndarray] = field(default_factory=dict)
    storage: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    seconds: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    params: Params = field(default_factory=Params)

    @property
    def revision(self) -> RevisionRow | None:
        """Newest revision; None if the map has no revisions."""
        return self.revisions[-1] if self.revisions else None

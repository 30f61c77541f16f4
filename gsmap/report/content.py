"""Content of a report: rows as the verbs print them, and the data of its drawings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from gsmap.report.params import Params
from gsmap.report.plan import Plan
from gsmap.types.metric_scale import MetricScale
from gsmap.types.rows import ChangesReport, EdgeRow, MapStatus, ObjectsReport, PoseChangeRow, RevisionRow, SceneRow

CHI2_DOF = 7
"""Degrees of freedom of an edge: rotation, translation, scale."""

CHI2_95, CHI2_999 = 14.067, 24.322
"""Quantiles of the chi-square distribution with 7 degrees of freedom: 95 % and 99.9 %."""


@dataclass(frozen=True, eq=False)
class SceneEntry:
    """A scene, and how surely it lies where it lies.

    Args:
        row: as `gsmap list` has it.
        num_cameras: how many cameras it has.
        num_bytes: of its arrays, as they were written.
        middle: (3,) the point where its pose is judged, frame and unit of its component: the middle of its cameras,
            else of what it shows; None where it has no pose.
        covariance_m2: (3, 3) of that point, axes of the component's frame; None where it is not known.
        rotation_sigma_deg: largest standard deviation of its rotation; None where it is not known.
    """

    row: SceneRow
    num_cameras: int = 0
    num_bytes: int = 0
    middle: np.ndarray | None = None
    covariance_m2: np.ndarray | None = None
    rotation_sigma_deg: float | None = None

    @property
    def position_sigma_m(self) -> float | None:
        """Standard deviation of that point along the axis where it is largest, metres; None where it is not known."""
        if self.covariance_m2 is None:
            return None
        return float(np.sqrt(max(0.0, np.linalg.eigvalsh(self.covariance_m2)[-1])))


@dataclass(frozen=True, eq=False)
class EdgeEntry:
    """An edge, and what the newest poses leave of it.

    Args:
        row: as `gsmap list` has it.
        chi2: of its residual under the newest poses, `CHI2_DOF` degrees of freedom; None where it has none.
        translation_m: how far the source's middle lies from where the edge alone would have it; None where the poses
            share no frame.
        rotation_deg: how far the source is turned from what the edge alone says; None as above.
        probability: that its pose is right, of all evidence (`gsmap.types.Registration`); None where unknown.
        component: of both its scenes; None where they share none.
    """

    row: EdgeRow
    chi2: float | None = None
    translation_m: float | None = None
    rotation_deg: float | None = None
    probability: float | None = None
    component: int | None = None

    @property
    def use(self) -> str:
        """``undecided``, ``tentative``, ``used``, ``unused`` (accepted, but no part of the answer), or its status."""
        if self.row.undecided:
            return "undecided"
        if self.row.used == "tentative":
            return "tentative"
        if self.row.used:
            return "used"
        return "unused" if self.row.status == "accepted" else self.row.status

    @property
    def doubt(self) -> float:
        """Urgency of a review in [0, 1]: undecided edges first, then edges that no cycle confirms, edges with residuals
        beyond their covariance, and excluded edges; within each group the less probable first. 0 after a review."""
        if self.row.review is not None:
            return 0.0
        unlikely = 1.0 - min(1.0, max(0.0, self.probability or 0.0))
        is_strained = self.use == "used" and (self.chi2 or 0.0) > CHI2_999
        low = {"undecided": 0.8, "tentative": 0.6, "unused": 0.2}.get(self.use, 0.4 if is_strained else None)
        return 0.0 if low is None else low + 0.19 * unlikely


@dataclass(frozen=True, eq=False)
class Island:
    """A component of the newest poses.

    Args:
        component: its index.
        scenes: names, of those it holds.
        metre: how long a metre is in its frame.
        plan: its floor plan; None where it is not drawn.
        note: why it is not, or how it was drawn; empty where there is nothing to say.
    """

    component: int
    scenes: tuple[str, ...]
    metre: MetricScale
    plan: Plan | None = None
    note: str = ""


@dataclass(frozen=True, eq=False)
class PairPicture:
    """Both captures of a pair from the same cameras, as ``gsmap show A:B --picture`` draws them: (H, W, 3) uint8."""

    row: EdgeRow
    picture: np.ndarray


@dataclass(frozen=True, eq=False)
class ChangePicture:
    """A change before and after, (H, W, 3) uint8, by its id (``c12``)."""

    change: str
    picture: np.ndarray


@dataclass(frozen=True, eq=False)
class PoseDifferences:
    """Differences of the scene poses between a revision and an earlier one."""

    before: int
    after: int
    rows: tuple[PoseChangeRow, ...]


@dataclass(frozen=True)
class Additions:
    """Additions to the map since a date.

    Args:
        since: ISO 8601.
        scenes: names of the captures that were ingested.
        num_tried: pairs that were registered.
        num_accepted: of these, accepted ones.
    """

    since: str
    scenes: tuple[str, ...] = ()
    num_tried: int = 0
    num_accepted: int = 0


@dataclass(frozen=True)
class StorageEntry:
    """Number and bytes of one kind of stored data."""

    kind: str
    count: int
    num_bytes: int


@dataclass(frozen=True, eq=False)
class Report:
    """Everything that a page tells of a map.

    Args:
        title: name of the map.
        map_id: id of the map.
        made_at: when the report was made, ISO 8601 with zone.
        version: of gsmap.
        status: what is to be done.
        scenes: the living scenes, oldest first.
        edges: the current edge of every pair that was tried.
        islands: the components, the largest first.
        revisions: the newest ones, oldest first.
        num_revisions: how many there are.
        moved: between each revision and the one before it, the newest first.
        moved_since: between the newest revision and the last one made before the date of ``news``; None where nobody
            asked, or there is none.
        changes: None before the first poses.
        objects: things and rooms of the map as they are kept; None where none are.
        pair_pictures, change_pictures: those that were drawn.
        storage: by kind, most bytes first.
        seconds: wall seconds that registering took, by step, as far as they are kept.
        news: what is new since a date; None where nobody asked.
        notes: what a person should know of the report itself.
        params: how much is shown.
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
    moved_since: PoseDifferences | None = None
    changes: ChangesReport | None = None
    objects: ObjectsReport | None = None
    pair_pictures: tuple[PairPicture, ...] = ()
    change_pictures: tuple[ChangePicture, ...] = ()
    storage: tuple[StorageEntry, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)
    news: Additions | None = None
    notes: tuple[str, ...] = ()
    params: Params = field(default_factory=Params)

    @property
    def revision(self) -> RevisionRow | None:
        """The newest one; None before the first."""
        return self.revisions[-1] if self.revisions else None

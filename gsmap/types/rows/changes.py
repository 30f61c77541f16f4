"""Changes between captures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from gsmap.types.rows.base import Row
from gsmap.types.rows.pairs import PairEventRow
from gsmap.types.sim3 import Sim3


@dataclass(frozen=True, eq=False, kw_only=True)
class VisitPairRef(Row):
    """Two captures of a place, the earlier one first.

    Args:
        older: id of the earlier capture.
        older_name: name of the earlier capture.
        older_at: date of the earlier capture, ISO 8601 with zone; null if its date was removed since.
        newer: id of the later capture.
        newer_name: name of the later capture.
        newer_at: date of the later capture, ISO 8601 with zone; null if its date was removed since.
    """

    columns: ClassVar[Mapping[str, str]] = {"pair": "pair"}

    older: str
    older_name: str
    older_at: str | None
    newer: str
    newer_name: str
    newer_at: str | None

    @property
    def pair(self) -> str:
        """The pair as ``OLDER:NEWER`` by scene names, the form that the command line takes."""
        return f"{self.older_name}:{self.newer_name}"


@dataclass(frozen=True, eq=False, kw_only=True)
class ChangeRow(VisitPairRef):
    """A change between two captures.

    Args:
        id: lasting id (``c12``), also kept when its pair is compared again.
        kind: ``appeared``, ``disappeared``, ``moved``, ``recoloured``, ``replaced`` (another object in its place) or
            ``lighting`` (same surfaces, other light).
        component: component of the box; null if the newer capture has no pose.
        box: (2, 3) lowest and highest corner around the change, map frame and unit; null if the newer capture has no
            pose.
        box_m: the box in metres; null if the newer capture has no pose.
        before: number of Gaussians of the older capture that disappeared or look different.
        after: number of Gaussians of the newer capture that appeared or look different.
        S_after_before: old to new pose of an object that moved, map frame; else null.
        symmetry: symmetry of an object that moved: ``none``, or the rotation about the vertical up to which its yaw is
            known: ``half`` or ``any``.
        confidence: probability in [0, 1] that something changed here, with a prior of one half.
        evidence: evidence values by name.
        status: review: ``open``, ``confirmed`` or ``rejected``.
        picture: image file with the change before and after; null if none was requested.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "id": "id",
        "kind": "kind",
        "pair": "pair",
        "component": "component",
        "at_m": "at (m)",
        "size_m": "size (m)",
        "confidence": "confidence",
        "status": "status",
    }

    id: str
    kind: str
    component: int | None
    box: np.ndarray | None
    box_m: np.ndarray | None
    before: int
    after: int
    S_after_before: Sim3 | None
    symmetry: str
    confidence: float
    evidence: Mapping[str, float]
    status: str
    picture: str | None = None

    @property
    def at_m(self) -> str:
        """Centre of the change's box, metres."""
        return "-" if self.box_m is None else _three(self.box_m.mean(0))

    @property
    def size_m(self) -> str:
        """Size of the change's box, metres."""
        return "-" if self.box_m is None else _three(self.box_m[1] - self.box_m[0])


def _three(values: np.ndarray) -> str:
    return " ".join(f"{value:.2f}" for value in values)


@dataclass(frozen=True, eq=False, kw_only=True)
class ComparisonRow(VisitPairRef):
    """The comparison of two captures.

    Args:
        num_changes: number of changes of any confidence.
        seen_share: fraction of the older capture's surface that the newer one observed.
        gains: (3,) factors from the older capture's colours to the newer's.
        compared_at: time of the comparison.
        notes: remarks.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "pair": "pair",
        "older_at": "from",
        "newer_at": "to",
        "num_changes": "changes",
        "seen_share": "seen",
    }

    num_changes: int
    seen_share: float
    gains: np.ndarray
    compared_at: str
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class ChangesReport(Row):
    """Changes and the compared pairs of captures.

    Args:
        changes: changes, latest pair first, within a pair most confident first.
        pairs: compared pairs of captures.
        notes: remarks, such as captures without a date.
    """

    columns: ClassVar[Mapping[str, str]] = {"changes": "changes", "pairs": "pairs"}

    changes: tuple[ChangeRow, ...]
    pairs: tuple[ComparisonRow, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class ChangeDetail(ChangeRow):
    """A change with its history.

    Args:
        num_voxels: number of changed cells.
        compared_at: time of the last comparison.
        notes: remarks on the comparison.
        history: reviews, oldest first.
    """

    columns: ClassVar[Mapping[str, str]] = ChangeRow.columns

    num_voxels: int
    compared_at: str
    notes: tuple[str, ...] = ()
    history: tuple[PairEventRow, ...] = ()

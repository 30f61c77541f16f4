"""What changed between captures."""

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
        older_name: its name.
        older_at: when it was captured, ISO 8601 with zone; null where its date was taken back since.
        newer: id of the later one.
        newer_name: its name.
        newer_at: when it was captured, as above.
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
        """``OLDER:NEWER`` by name, as the command line takes it."""
        return f"{self.older_name}:{self.newer_name}"


@dataclass(frozen=True, eq=False, kw_only=True)
class ChangeRow(VisitPairRef):
    """Something that changed between two captures.

    Args:
        id: what it is called (``c12``), also after its pair was compared again.
        kind: ``appeared``, ``disappeared``, ``moved``, ``recoloured``, ``replaced`` (another thing in its place) or
            ``lighting`` (the same surfaces, lit otherwise).
        component: in whose frame the box lies; null where the newer capture has no place now.
        box: (2, 3) lowest and highest corner around all that changed, map frame and unit; null as above.
        box_m: the same in metres.
        before: how many Gaussians of the older capture are no longer there, or no longer look so.
        after: how many of the newer capture were not there, or did not look so.
        S_after_before: of a thing that moved: takes a point of it from where it stood to where it stands, map frame.
        symmetry: of a thing that moved: ``none``, or the turn about the vertical up to which its yaw is known: ``half``
            or ``any``.
        confidence: in [0, 1], how probable it is that something changed here, of as many right ones as wrong.
        evidence: numbers behind it, by name.
        status: what people say of it: ``open``, ``confirmed`` or ``rejected``.
        picture: file with the thing before and after, where pictures were asked for; else null.
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
        """The middle of its box."""
        return "-" if self.box_m is None else _three(self.box_m.mean(0))

    @property
    def size_m(self) -> str:
        """Of its box."""
        return "-" if self.box_m is None else _three(self.box_m[1] - self.box_m[0])


def _three(values: np.ndarray) -> str:
    return " ".join(f"{value:.2f}" for value in values)


@dataclass(frozen=True, eq=False, kw_only=True)
class ComparisonRow(VisitPairRef):
    """Two captures that were compared.

    Args:
        num_changes: how many changes were found, of whatever confidence.
        seen_share: share of the older capture's surface that the newer one looked at; of the rest nothing is said.
        gains: (3,) by which the older capture's colours are to be multiplied to look like the newer's.
        compared_at: when they were compared.
        notes: what a person should know.
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
    """What changed between captures, and which of them were compared.

    Args:
        changes: what changed; of each pair surest first, the latest pair first.
        pairs: the pairs of captures that were compared.
        notes: what a person should know, such as captures without a date.
    """

    columns: ClassVar[Mapping[str, str]] = {"changes": "changes", "pairs": "pairs"}

    changes: tuple[ChangeRow, ...]
    pairs: tuple[ComparisonRow, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class ChangeDetail(ChangeRow):
    """Everything known of one change.

    Args:
        num_voxels: how many cells changed.
        compared_at: when it was found last.
        notes: what a person should know of how its pair was compared.
        history: what people said of it, oldest first.
    """

    columns: ClassVar[Mapping[str, str]] = ChangeRow.columns

    num_voxels: int
    compared_at: str
    notes: tuple[str, ...] = ()
    history: tuple[PairEventRow, ...] = ()

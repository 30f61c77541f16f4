"""Pairs of scenes: edges and what is known of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from gsmap.types.rows.base import Row
from gsmap.types.sim3 import Sim3


@dataclass(frozen=True, eq=False, kw_only=True)
class PairRef(Row):
    """Two scenes by id and name.

    Args:
        target: id of the scene in whose frame the other is placed.
        target_name: its name.
        source: id of the other.
        source_name: its name.
    """

    columns: ClassVar[Mapping[str, str]] = {"pair": "pair"}

    target: str
    target_name: str
    source: str
    source_name: str

    @property
    def pair(self) -> str:
        """``TARGET:SOURCE`` by name, as the command line takes it."""
        return f"{self.target_name}:{self.source_name}"


@dataclass(frozen=True, eq=False, kw_only=True)
class EdgeRow(PairRef):
    """The current edge of one pair that was tried.

    Args:
        status: ``accepted``, ``rejected`` (a pose was found and contradicted), ``no_match``, or ``never registered``
            where the pair has no edge; what a person's review says counts before what registration found.
        reason: why it is not accepted, or why the last optimize did not use it; empty where there is nothing to say.
        S_target_source: how the source lies in the target; null where no pose was found.
        scale: of that pose; null as above.
        information: (7, 7) over [rotation (3, rad), translation (3), log scale] applied on the source side,
            translation in the source's unit; null where no pose was found.
        num_inliers: size of the accepted set of correspondences.
        num_correspondences: candidates it was chosen from.
        overlap: share of the smaller scene's surface that coincides, in [0, 1].
        seconds: wall seconds spent in ``match``, ``refine`` and ``verdict``.
        used: whether the last optimize used it: true, false, or ``"tentative"`` (neither a cycle nor a
            person confirms it).
        undecided: whether nothing could tell if it is right: another group of edges contradicts it.
        review: a person's standing word: ``confirm`` or ``reject``; null where there is none.
        proposer: what proposed the pose (``graph:landmarks``, ``graph:objects``, ``kiss_matcher``), or ``manual`` where
            a person measured it; empty where none was found.
        registered_at: when it was registered, ISO 8601 with zone.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "pair": "pair",
        "status": "status",
        "used": "used",
        "overlap": "overlap",
        "num_inliers": "inliers",
        "scale": "scale",
        "reason": "reason",
    }

    status: str
    reason: str
    S_target_source: Sim3 | None
    scale: float | None
    information: np.ndarray | None
    num_inliers: int
    num_correspondences: int
    overlap: float
    seconds: Mapping[str, float]
    used: bool | str
    undecided: bool = False
    review: str | None = None
    proposer: str = ""
    registered_at: str | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class PairEventRow(Row):
    """Something that happened to a pair.

    Args:
        at: when, ISO 8601 with zone.
        what: the status that registration found, or a person's word: ``confirm``, ``reject`` or ``withdraw``.
        reason: why.
    """

    columns: ClassVar[Mapping[str, str]] = {"at": "at", "what": "what", "reason": "reason"}

    at: str
    what: str
    reason: str


@dataclass(frozen=True, eq=False, kw_only=True)
class PairReport(EdgeRow):
    """Everything known of one pair.

    Args:
        exact: whether the clique search proved its answer largest.
        evidence: the figures that the verdict rests on, by name.
        residual_chi2: chi-square of the edge under the newest poses (7 degrees of freedom); null where it has none.
        notes: what a person should know of how it was registered.
        history: every registration and review of the pair, oldest first.
    """

    columns: ClassVar[Mapping[str, str]] = EdgeRow.columns

    exact: bool = True
    evidence: Mapping[str, float]
    residual_chi2: float | None = None
    notes: tuple[str, ...] = ()
    history: tuple[PairEventRow, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class WhyStep(Row):
    """One thing that was asked of a pair on the way from being found to its place in the map.

    Args:
        name: what was asked.
        value: the answer; null where there is none.
        bar: what it is held against, in words; empty where it is told for information alone.
        passed: whether it cleared the bar; null where there is no bar or no answer.
    """

    columns: ClassVar[Mapping[str, str]] = {"name": "step", "value": "value", "bar": "bar", "passed": "passed"}

    name: str
    value: float | int | str | None
    bar: str = ""
    passed: bool | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class WhyReport(PairRef):
    """Why a pair is an edge of the map, or is not.

    Args:
        status: as in `EdgeRow`.
        reason: as in `EdgeRow`.
        steps: from retrieval to the place in the map.
        advice: what would settle it; empty where nothing is open.
        picture: file with both captures seen from the same cameras, where it was asked for and there is a pose.
    """

    status: str
    reason: str
    steps: tuple[WhyStep, ...]
    advice: str
    picture: str | None = None

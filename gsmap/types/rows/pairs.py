"""Pairs of scenes and their edges."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from gsmap.types.registration import RegisteredPose
from gsmap.types.rows.base import Row


@dataclass(frozen=True, eq=False, kw_only=True)
class PairRef(Row):
    """Two scenes by id and name.

    Args:
        target: id of the scene whose frame the pose is in.
        target_name: name of the target scene.
        source: id of the other scene.
        source_name: name of the source scene.
    """

    columns: ClassVar[Mapping[str, str]] = {"pair": "pair"}

    target: str
    target_name: str
    source: str
    source_name: str

    @property
    def pair(self) -> str:
        """The pair as ``TARGET:SOURCE`` by scene names, the form that the command line takes."""
        return f"{self.target_name}:{self.source_name}"


@dataclass(frozen=True, eq=False, kw_only=True)
class EdgeRow(RegisteredPose, PairRef):
    """The current edge of a registered pair.

    Args:
        status: ``accepted``, ``rejected`` (a contradicted pose), ``no_match``, or ``never registered`` without an edge;
            a review takes precedence.
        reason: reason why it is not accepted or not used, or empty.
        reason_code: code of the reason, a key of `gsmap.reason_codes.REASONS`, or empty.
        scale: scale of the pose; null if none was found.
        seconds: wall time in seconds of ``match``, ``refine`` and ``verdict``.
        used: use by the last optimize: true, false, or ``"tentative"`` (neither a cycle nor a review confirms it).
        undecided: true if another group of edges contradicts it and nothing decides between them.
        unsolved: true if the edge or its review is newer than the last optimize, which ``used`` and ``undecided`` are
            of.
        review: standing review: ``confirm`` or ``reject``; null if unreviewed.
        registered_at: time of the registration, ISO 8601 with zone.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "pair": "pair",
        "status": "status",
        "use": "use",
        "overlap": "overlap",
        "num_inliers": "inliers",
        "scale": "scale",
        "reason": "reason",
    }

    @property
    def use(self) -> str:
        """``used``, ``one pair`` (it places a scene alone, and nothing contradicts it), ``tentative`` (in doubt),
        ``undecided``, ``unused``, ``unsolved``, or empty if it is not accepted: the words by which edges are
        filtered."""
        if self.unsolved:
            return "unsolved"
        if self.undecided:
            return "undecided"
        if self.used == "tentative":
            return "one pair" if self.reason_code == "unconfirmed" else "tentative"
        if self.used:
            return "used"
        return "unused" if self.status == "accepted" else ""

    reason_code: str = ""
    scale: float | None
    seconds: Mapping[str, float]
    used: bool | str
    undecided: bool = False
    unsolved: bool = False
    review: str | None = None
    registered_at: str | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class PairEventRow(Row):
    """An event in the history of a pair.

    Args:
        at: time, ISO 8601 with zone.
        what: status of a registration, or a review: ``confirm``, ``reject`` or ``withdraw``.
        reason: reason.
        reason_code: as in `EdgeRow`; empty for a review.
    """

    columns: ClassVar[Mapping[str, str]] = {"at": "at", "what": "what", "reason": "reason"}

    at: str
    what: str
    reason: str
    reason_code: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class PairReport(EdgeRow):
    """A pair with its evidence and history.

    Args:
        exact: true if the clique search proved its result largest.
        evidence: evidence values by name.
        residual_chi2: chi-square of the edge under the newest poses (7 degrees of freedom); null where it has none.
        notes: remarks on the registration.
        history: every registration and review of the pair, oldest first.
    """

    columns: ClassVar[Mapping[str, str]] = EdgeRow.columns

    exact: bool = True
    evidence: Mapping[str, float]
    residual_chi2: float | None = None
    notes: tuple[str, ...] = ()
    history: tuple[PairEventRow, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class ExplanationStep(Row):
    """One step in the processing of a pair, from retrieval to the pose graph.

    Args:
        name: name of the step.
        value: result; null if there is none.
        bar: threshold as text; empty if there is none.
        passed: true if the threshold is met; null without threshold or result.
    """

    columns: ClassVar[Mapping[str, str]] = {"name": "step", "value": "value", "bar": "bar", "passed": "passed"}

    name: str
    value: float | int | str | None
    bar: str = ""
    passed: bool | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class PairExplanation(PairRef):
    """An explanation why a pair is, or is not, an edge.

    Args:
        status: as in `EdgeRow`.
        reason: as in `EdgeRow`.
        reason_code: as in `EdgeRow`.
        steps: steps from retrieval to the pose graph.
        advice: advice for the first open step, or empty.
        picture: image file with both captures seen from the same cameras; null if not requested or without a pose.
    """

    status: str
    reason: str
    reason_code: str = ""
    steps: tuple[ExplanationStep, ...]
    advice: str
    picture: str | None = None

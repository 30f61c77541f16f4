"""Report changes between visits as typed rows, in the current map frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from gsmap.errors import ConfigError, NotFoundError
from gsmap.geometry.boxes import moved_box
from gsmap.map.date_filter import end_of_date, parse_moment
from gsmap.map.metric_scales import map_metres, metre_notes
from gsmap.map.reports import scenes_by_id
from gsmap.map.settings import Settings
from gsmap.map.snapshot_read import snapshot_read
from gsmap.store import Store
from gsmap.store.change_rows import Comparison, StoredChange
from gsmap.store.changes import number_of
from gsmap.texts import counted
from gsmap.types import Change, PoseGraph, Scene
from gsmap.types.metric_scale import MetricScale
from gsmap.types.rows.changes import ChangeDetail, ChangeRow, ChangesReport, ComparisonRow
from gsmap.types.rows.pairs import PairEventRow

if TYPE_CHECKING:
    from gsmap.map.changes.compare import ComparisonPlan


def parse_change_id(text: str) -> int:
    """Return the number of a change id such as ``c12``.

    Raises:
        NotFoundError: changes are not called so.
    """
    number = number_of(text)
    if number is None:
        raise NotFoundError(
            f"there is no change {text!r}: change ids are c1, c2, ... (gsmap changes MAP lists them)",
            code="change_not_found",
        )
    return number


def filter_by_date(
    asked: ComparisonPlan, since: str | None, between: Sequence[str] | None, as_of: str | None
) -> ComparisonPlan:
    """Keep the pairs whose newer scene was captured after ``since`` (or within ``between``) and not after ``as_of``. An
    end without a time of day is the end of that day.

    Raises:
        ConfigError: a date that is none, two ways of saying since when, or an end before its beginning.
    """
    if since is not None and between is not None:
        raise ConfigError("give --since or --between, not both", code="conflicting_options")
    first = between[0] if between is not None else since
    start = None if first is None else parse_moment(first)
    ends = [end_of_date(text) for text in (between[1] if between is not None else None, as_of) if text is not None]
    if start is not None and any(end < start for end in ends):
        raise ConfigError(
            f"the period ends before it begins ({first}): give the earlier date first",
            code="date_out_of_range",
        )

    def holds(when: datetime) -> bool:
        return (start is None or when > start) and all(when <= end for end in ends)

    return replace(asked, pairs=[pair for pair in asked.pairs if holds(asked.visits[pair[1]].when)])


@snapshot_read
def changes_report(
    store: Store,
    settings: Settings,
    asked: ComparisonPlan,
    *,
    min_confidence: float,
) -> ChangesReport:
    """Report the stored changes of the planned comparisons."""
    from gsmap.map.changes.compare import (
        missing_comparisons,  # with the comparison, which looking at a change does without
    )

    known, (placed, metres) = scenes_by_id(store), _placed(store)
    missing = set(missing_comparisons(store, asked, settings))
    pairs = set(asked.pairs)
    chosen = [one for one in store.changes.current() if (one.older, one.newer) in pairs]
    chosen.sort(key=lambda one: (asked.visits[one.newer].when, asked.visits[one.older].when), reverse=True)
    stale = [one for one in chosen if (one.older, one.newer) in missing]
    never = missing - {(one.older, one.newer) for one in chosen}
    notes = list(asked.notes)
    if stale:
        notes.append(f"{counted(len(stale), 'pair')} compared by another recipe or at other poses: {_WRITE}")
    if never:
        notes.append(f"{counted(len(never), 'pair')} not compared yet: {_WRITE}")
    if chosen and placed is not None:
        mine = {placed.poses[one.newer].component for one in chosen if one.newer in placed.poses}
        notes += metre_notes({component: metre for component, metre in metres.items() if component in mine})
    rows = [_row(one, change, known, placed, metres) for one in chosen for change in one.changes]
    return ChangesReport(
        changes=tuple(ChangeRow(**row) for row in rows if row["confidence"] >= min_confidence),
        pairs=tuple(_comparison_row(one, known) for one in chosen),
        notes=tuple(notes),
    )


_WRITE = "run gsmap changes with write access to the map"


@snapshot_read
def change_row(store: Store, number: int) -> ChangeRow:
    """Return one change, in the current map frame."""
    comparison, change = _find(store, number)
    return ChangeRow(**_row(comparison, change, scenes_by_id(store), *_placed(store)))


def change_arrays(store: Store, number: int) -> Change:
    """Return one change with its arrays, in the current map frame.

    Raises:
        NotFoundError: no such change, or the newer capture has no place now.
        CorruptError: its arrays are damaged.
    """
    comparison, change = _find(store, number)
    graph = store.revisions.get()
    if graph is None or comparison.newer not in graph.poses:
        raise NotFoundError(
            f"c{number} has no position: its newer capture has no pose; run gsmap update", code="change_unplaced"
        )
    S = graph.poses[comparison.newer].S_map_scene @ comparison.S_frame_newer.inverse()
    found = store.changes.load(comparison.number).changes[change.place]
    moved = found.S_after_before
    return replace(
        found,
        box=moved_box(found.box, S),
        voxels=S.apply(found.voxels).astype(np.float32),
        S_after_before=None if moved is None else S @ moved @ S.inverse(),
    )


@snapshot_read
def change_detail(store: Store, number: int) -> ChangeDetail:
    """Report one change with its history of reviews."""
    comparison, change = _find(store, number)
    words = [PairEventRow(at=one.created_at, what=one.review, reason=one.note) for one in store.changes.reviews(number)]
    return ChangeDetail(
        **_row(comparison, change, scenes_by_id(store), *_placed(store)),
        num_voxels=change.num_voxels,
        compared_at=comparison.created_at,
        notes=comparison.notes,
        history=tuple(words),
    )


def num_open(store: Store, settings: Settings) -> int:
    """Count the unreviewed changes above the minimum confidence in the pairs that ``gsmap changes`` compares."""
    found = [
        (one.older, one.newer)
        for one in store.changes.current()
        for change in one.changes
        if change.status == "open" and change.confidence >= settings.change.min_confidence
    ]
    if not found or store.revisions.newest_number() is None:
        return 0
    from gsmap.map.changes.compare import plan_comparisons

    pairs = set(plan_comparisons(store, settings).pairs)
    return sum(pair in pairs for pair in found)


def _find(store: Store, number: int) -> tuple[Comparison, StoredChange]:
    change = store.changes.get(number)
    return store.changes.comparison(change.comparison), change


def _pair(one: Comparison, known: dict[str, Scene]) -> dict[str, Any]:
    older, newer = known[one.older], known[one.newer]
    return {
        "older": older.id,
        "older_name": older.name,
        "older_at": older.captured_at,
        "newer": newer.id,
        "newer_name": newer.name,
        "newer_at": newer.captured_at,
    }


def _placed(store: Store) -> tuple[PoseGraph | None, dict[int, MetricScale]]:
    """Return the newest poses and the metric scale of each component."""
    graph = store.revisions.get()
    return graph, map_metres(store, graph)


def _row(
    one: Comparison,
    change: StoredChange,
    known: dict[str, Scene],
    placed: PoseGraph | None,
    metres: Mapping[int, MetricScale],
) -> dict[str, Any]:
    """Return the fields of a `ChangeRow`, transformed from the map frame of the comparison to the current map frame."""
    pose = placed.poses.get(one.newer) if placed is not None else None
    S_map_frame = None if pose is None else pose.S_map_scene @ one.S_frame_newer.inverse()
    box = None if S_map_frame is None else moved_box(change.box, S_map_frame)
    moved = None
    if S_map_frame is not None and change.S_after_before is not None:
        moved = S_map_frame @ change.S_after_before @ S_map_frame.inverse()
    return {
        **_pair(one, known),
        "id": f"c{change.number}",
        "kind": change.kind,
        "component": None if pose is None else pose.component,
        "box": box,
        "box_m": None if box is None or pose is None else box * metres[pose.component].metres_per_unit,
        "before": change.num_before,
        "after": change.num_after,
        "S_after_before": moved,
        "symmetry": change.symmetry,
        "confidence": change.confidence,
        "evidence": dict(change.evidence),
        "status": change.status,
    }


def _comparison_row(one: Comparison, known: dict[str, Scene]) -> ComparisonRow:
    return ComparisonRow(
        **_pair(one, known),
        num_changes=len(one.changes),
        seen_share=one.seen_share,
        gains=one.gains,
        compared_at=one.created_at,
        notes=one.notes,
    )

"""Report pairs of scenes: edges, evidence and reviews."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any

from gsmap.map.date_filter import is_after, parse_moment
from gsmap.map.reports.common import names, one_of
from gsmap.map.reports.one_pair import ONE_PAIR
from gsmap.map.reports.scenes import scene_rows, spelled
from gsmap.map.snapshot_read import snapshot_read
from gsmap.reason_codes import reason, reason_code
from gsmap.store import Store
from gsmap.store.registrations import StoredRegistration
from gsmap.types import EdgeOutcome, Registration, Scene
from gsmap.types.plain import fields_of
from gsmap.types.registration import RegisteredPose
from gsmap.types.rows.pairs import EdgeRow, PairEventRow, PairReport

Outcomes = Mapping[tuple[str, str], EdgeOutcome]
_FEW = 1000  # scenes that one query names; beyond, all outcomes are read
EDGE_STATUSES = ("accepted", "rejected", "no_match")
EDGE_USES: Mapping[str, Callable[[EdgeRow], bool]] = {
    "used": lambda row: row.use == "used",
    ONE_PAIR: lambda row: row.use == ONE_PAIR,
    "tentative": lambda row: row.use in ("tentative", ONE_PAIR),  # as JSON has it: those of one pair, too
    "undecided": lambda row: row.use == "undecided",
    "unused": lambda row: row.use == "unused",
    "unsolved": lambda row: row.unsolved,
}
"""Words for the use of an edge by the last optimize, by which edges can also be filtered."""


@snapshot_read
def edge_rows(
    store: Store,
    *,
    component: int | None = None,
    status: str | None = None,
    after: str | None = None,
    tag: str | None = None,
    as_of: str | None = None,
) -> list[EdgeRow]:
    """List the current edge of every registered pair.

    Args:
        component, tag: restrict to edges with both scenes in the component or with the tag.
        status: restrict to a status or use: one of `EDGE_STATUSES` or `EDGE_USES`.
        after: ISO 8601; restrict to edges registered later.
        as_of: ISO 8601; restrict to edges with both scenes dated at or before it.

    Raises:
        ConfigError: no such status, or a date that is none.
    """
    status = None if status is None else spelled(status)
    one_of(status, (*EDGE_STATUSES, *EDGE_USES))
    since = None if after is None else parse_moment(after)
    inside = None
    if component is not None or tag is not None or as_of is not None:
        inside = {row.id for row in scene_rows(store, component=component, tag=tag, as_of=as_of)}
    return [
        row
        for row in rows_of_registrations(store, store.registrations.current(brief=True))
        if (inside is None or {row.target, row.source} <= inside)
        and (status is None or (EDGE_USES[status](row) if status in EDGE_USES else row.status == status))
        and (since is None or is_after(row.registered_at, since))
    ]


@snapshot_read
def edges_of_pairs(store: Store, pairs: Collection[tuple[str, str]]) -> list[EdgeRow]:
    """List the current edges of some pairs of scenes (ids), by the pair's first registration."""
    if not pairs:
        return []
    scenes = {scene for pair in pairs for scene in pair}
    return rows_of_registrations(store, store.registrations.current_of_pairs(pairs), *sorted(scenes))


@snapshot_read
def rows_of_edges(store: Store, made: Iterable[Registration]) -> list[EdgeRow]:
    """List the current edges of the pairs of these registrations, in their order."""
    made = list(made)
    found = edges_of_pairs(store, [(edge.target, edge.source) for edge in made])
    rows = {frozenset((row.target, row.source)): row for row in found}
    return [rows[frozenset((edge.target, edge.source))] for edge in made]


@snapshot_read
def edge_row(store: Store, a: Scene, b: Scene) -> EdgeRow:
    """Return the current edge of a pair, or a row with the status ``never registered``."""
    current = store.registrations.get(a.id, b.id)
    return EdgeRow(**_never_registered(a, b)) if current is None else rows_of_registrations(store, [current], a.id)[0]


def edges_of_scene(store: Store, scene: Scene) -> list[EdgeRow]:
    """List the current edge of every registered pair of a scene."""
    return rows_of_registrations(store, store.registrations.current_of_scene(scene.id), scene.id)


def rows_of_registrations(store: Store, edges: Iterable[StoredRegistration], *scenes: str) -> list[EdgeRow]:
    """Return the rows of registrations.

    Args:
        scenes: ids, at least one of each pair; all where none is named.
    """
    edges = list(edges)
    unsolved = _unsolved(store, edges)
    outcomes, name_of = store.revisions.outcomes(*(scenes if len(scenes) <= _FEW else ())), names(store)
    return [_edge_row(stored, outcomes, name_of, stored.number in unsolved) for stored in edges]


def _unsolved(store: Store, edges: Iterable[StoredRegistration]) -> set[int]:
    """Return the numbers of those registrations that the last optimize did not use as they are now."""
    newest = store.revisions.newest()
    return store.registrations.changed_since(newest.created_at if newest else "", edges)


def _edge_row(stored: StoredRegistration, outcomes: Outcomes, name_of: Mapping[str, str], unsolved: bool) -> EdgeRow:
    edge = stored.registration
    outcome = outcomes.get((edge.target, edge.source))
    status, why = edge.status, edge.reason or (outcome.reason if outcome else "")
    used = _USED[outcome.use] if outcome else False
    if stored.review == "confirm":
        status, why = "accepted", reason("confirmed_by_person", "confirmed by a person")
        used = bool(used)  # a tentative edge holds its scenes; the person now confirms it in place of a cycle
    elif stored.review == "reject":
        status, why = "rejected", reason("rejected_by_person", "rejected by a person")
    row = {
        "target_name": name_of[edge.target],
        "source_name": name_of[edge.source],
        "status": status,
        "reason": why,
        "reason_code": reason_code(why),
        "scale": edge.scale,
        "seconds": {step: edge.seconds.get(step, 0.0) for step in ("match", "refine", "verdict")},
        "used": used,
        "undecided": outcome is not None and outcome.undecided,
        "unsolved": unsolved,
        "review": stored.review,
        "registered_at": stored.created_at,
    }
    return EdgeRow(**fields_of(edge, RegisteredPose) | row)


_USED: dict[str, bool | str] = {"used": True, "tentative": "tentative", "unused": False}


@snapshot_read
def pair_report(store: Store, a: Scene, b: Scene) -> PairReport:
    """Report a pair: its current edge, evidence, and history of registrations and reviews."""
    current = store.registrations.get(a.id, b.id)
    events = [
        PairEventRow(
            at=old.created_at,
            what=old.registration.status,
            reason=old.registration.reason,
            reason_code=old.registration.reason_code,
        )
        for old in store.registrations.history(a.id, b.id)
    ]
    events += [
        PairEventRow(at=word.created_at, what=word.review, reason=word.note)
        for word in store.registrations.reviews(a.id, b.id)
    ]
    history = tuple(sorted(events, key=lambda event: event.at))
    if current is None:
        return PairReport(**_never_registered(a, b), evidence={}, history=history)
    outcomes, edge = store.revisions.outcomes(a.id), current.registration
    outcome = outcomes.get((edge.target, edge.source))
    return PairReport(
        **vars(_edge_row(current, outcomes, {a.id: a.name, b.id: b.name}, bool(_unsolved(store, [current])))),
        exact=edge.exact,
        evidence=edge.evidence,
        residual_chi2=outcome.residual_chi2 if outcome else None,
        notes=edge.notes,
        history=history,
    )


def _never_registered(a: Scene, b: Scene) -> dict[str, Any]:
    """Return the fields of `EdgeRow` for a pair without an edge."""
    return {
        "target": a.id,
        "target_name": a.name,
        "source": b.id,
        "source_name": b.name,
        "status": "never registered",
        "scale": None,
        "seconds": {},
        "used": False,
    }

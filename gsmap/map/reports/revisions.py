"""Report revisions and the differences between them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

from gsmap.map.date_filter import is_after, parse_moment
from gsmap.map.metric_scales import metres_of_scenes
from gsmap.map.reports.common import names, refs, scenes_by_id
from gsmap.map.reports.pairs import edges_of_pairs
from gsmap.map.reports.scenes import scene_rows
from gsmap.map.snapshot_read import snapshot_read
from gsmap.store import Store
from gsmap.store.revisions import Revision
from gsmap.types.metric_scale import MetricScale
from gsmap.types.rows.pairs import PairRef
from gsmap.types.rows.revisions import PoseChangeRow, RevisionRow, UpdateReport
from gsmap.types.rows.scenes import IngestRow


@snapshot_read
def revision_rows(store: Store) -> list[RevisionRow]:
    """List all revisions, oldest first."""
    name_of, undecided = names(store), store.revisions.undecided()
    return [_revision_row(revision, undecided.get(revision.number, ()), name_of) for revision in store.revisions.list()]


def made_after(rows: Iterable[RevisionRow], after: str | None) -> list[RevisionRow]:
    """Keep the revisions that were made after a date (ISO 8601); keep all if the date is None.

    Raises:
        ConfigError: a date that is none.
    """
    since = None if after is None else parse_moment(after)
    return [row for row in rows if since is None or is_after(row.created_at, since)]


@snapshot_read
def revision_row(store: Store, number: int) -> RevisionRow:
    """Return the row of a revision."""
    undecided = store.revisions.undecided(number).get(number, ())
    return _revision_row(store.revisions.entry(number), undecided, names(store))


def _revision_row(revision: Revision, undecided: Sequence[tuple[str, str]], name_of: Mapping[str, str]) -> RevisionRow:
    return RevisionRow(
        number=revision.number,
        created_at=revision.created_at,
        scenes=revision.num_scenes,
        components=revision.num_components,
        edges_used=revision.num_used,
        edges_tentative=revision.num_tentative,
        edges_refused=revision.num_unused,
        undecided=tuple(
            PairRef(target=a, target_name=name_of[a], source=b, source_name=name_of[b])
            for a, b in (() if revision.dropped_at else undecided)
        ),
        solver=revision.provenance.method,
        contradicted_priors=refs(revision.provenance.contradicted_priors, name_of),
        settings=revision.settings,
        notes=revision.notes,
        note=revision.note,
        key=revision.key,
        dropped_at=revision.dropped_at,
    )


@snapshot_read
def pose_change_rows(store: Store, before: int, after: int) -> list[PoseChangeRow]:
    """List how each scene's pose differs between two revisions, measured at the scene's centre.

    Raises:
        NotFoundError: no such revision.
    """
    from gsmap.optimize import diff

    old, new = store.revisions.get(before), store.revisions.get(after)
    assert old is not None
    assert new is not None
    known, metres = scenes_by_id(store), metres_of_scenes(store, new)
    changes = diff(old, new, {scene.id: scene.bounds.mean(0) for scene in known.values()})
    return [
        PoseChangeRow(
            scene=change.scene,
            scene_name=known[change.scene].name,
            change=change.kind,
            rotation_deg=change.rotation_deg,
            translation_m=None if change.translation is None else change.translation * metres[change.scene],
            scale_ratio=change.scale_ratio,
            component_before=change.components[0],
            component_after=change.components[1],
            status_before=change.statuses[0],
            status_after=change.statuses[1],
        )
        for change in changes.values()
    ]


@dataclass(frozen=True)
class HistoryPosition:
    """A position in a map's history: its newest revision and registration (0 before the first), and its graphs."""

    revision: int
    registration: int
    graphs: Collection[str]


@snapshot_read
def history_position(store: Store) -> HistoryPosition:
    """Return the current position in the history."""
    return HistoryPosition(
        store.revisions.newest_number() or 0, store.registrations.newest_number(), store.graphs.groups().keys()
    )


@snapshot_read
def update_report(
    store: Store, ingested: Sequence[IngestRow], since: HistoryPosition, metres: Callable[[], Mapping[int, MetricScale]]
) -> UpdateReport:
    """Report what an update ingested and which results changed since a position in the history.

    Args:
        metres: returns the metric scale of every component of the newest poses.
    """
    from gsmap.map.undated_overlaps import undated_notes  # imported here, as verbs that only read do not need it

    scenes, pairs = store.revisions.changed_after(since.revision)
    scenes |= {scene for group, scene in store.graphs.groups().items() if group not in since.graphs}
    scenes |= {row.scene for row in ingested if row.new or row.dated}
    pairs |= store.registrations.pairs_registered_after(since.registration)
    newest = store.revisions.newest_number()
    return UpdateReport(
        ingested=tuple(ingested),
        scenes=tuple(scene_rows(store, metres=metres() if scenes else None, among=scenes)),
        edges=tuple(edges_of_pairs(store, pairs)),
        revision=None if newest is None else revision_row(store, newest),
        notes=undated_notes(store, store.scenes.summaries()) if pairs else (),
    )

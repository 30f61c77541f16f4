"""Revisions: all pose graphs from the optimizer, immutable and numbered from 1.

Rows shared by consecutive revisions are stored once: a row of `poses` and `edges` is valid from one revision up to
another (`gsmap.store.schema`). The newest poses are the rows without an end; those of another revision are the rows
around its number, so that reading one needs no chain of others, and dropping some leaves nothing to merge.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

from sqlalchemy import (
    ColumnElement,
    Connection,
    LargeBinary,
    Row,
    Select,
    Table,
    bindparam,
    delete,
    exists,
    func,
    insert,
    or_,
    select,
    type_coerce,
    update,
)

from gsmap.errors import NotFoundError
from gsmap.methods import RecipeKey
from gsmap.store import recipes
from gsmap.store.catalog import Catalog, now
from gsmap.store.column_types import PackedNumbers, corrupt_value, malformed_as_corrupt
from gsmap.store.matrices import covariance_bytes, covariances_of_bytes, pose_bytes, poses_of_bytes
from gsmap.store.schema import REVISION_COUNTS, edges, poses, revisions
from gsmap.store.world_ties import world_tie_to_json, world_ties_of_json
from gsmap.types import EdgeOutcome, PoseGraph, Provenance, ScenePose
from gsmap.types.plain import plain
from gsmap.types.world import Georeference

PairsByRevision = dict[int, list[tuple[str, str]]]


@dataclass(frozen=True)
class Revision:
    """An entry of the revision history.

    Args:
        number: from 1.
        num_scenes, num_placed, num_components: numbers of scenes, of scenes with a pose, and of connected components.
        num_used, num_tentative, num_unused, num_undecided: edges by outcome (undecided ones are counted in addition).
            All counts are as of its creation and include scenes purged since.
        note: why it was made.
        dropped_at: when `prune` dropped it; None while it is kept.
        key: `RecipeKey.digest` of what it was solved from.
        recipe: digest of its recipe (`gsmap.store.recipes.Recipes.get`).
        settings, provenance, notes: as in `gsmap.types.PoseGraph`.
        origin: ``map`` (its id) and ``number`` of a revision that another map solved; None for one solved by this map.
    """

    number: int
    created_at: str
    num_scenes: int
    num_placed: int
    num_components: int
    num_used: int
    num_tentative: int
    num_unused: int
    num_undecided: int
    note: str = ""
    dropped_at: str | None = None
    key: str = ""
    recipe: str | None = None
    origin: dict[str, Any] | None = None
    settings: dict[str, Any] = field(default_factory=dict)
    provenance: Provenance = field(default_factory=Provenance)
    notes: tuple[str, ...] = ()


class Revisions:
    """The pose graphs of a map."""

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog

    def save(
        self,
        graph: PoseGraph,
        key: RecipeKey | None = None,
        note: str = "",
        after: tuple[int, PoseGraph] | None = None,
    ) -> int:
        """Add a revision and return its number. All its scenes must be in the map.

        Args:
            key: its recipe and inputs; None for a pose graph that was not optimized.
            note: why it was made.
            after: number and pose graph of the revision that it was made from. If that is the newest, objects that are
                identical in both are not compared again.
        """
        with self._catalog.write() as connection:
            newest = _newest(connection) or 0
            number = 1 + newest
            row = {
                "number": number,
                "key": "" if key is None else key.digest,
                "recipe": recipes.save_recipe(connection, key),
                "settings": plain(graph.settings),
                "provenance": plain(graph.provenance),
                "notes": list(graph.notes),
                "world": [world_tie_to_json(tie) for tie in graph.world],
                "note": note,
                "created_at": now(),
            }
            if after is None or after[0] != newest:
                insert_revision(connection, row, rows_of_graph(graph))
            else:
                differs = _differing(graph, after[1])
                connection.execute(insert(revisions), {**row, **_counts(graph)})
                _write(connection, number, rows_of_graph(graph, differs), differs)
        return number

    def newest_number(self) -> int | None:
        """Return the number of the newest revision; None before the first."""
        with self._catalog.read() as connection:
            return _newest(connection)

    def get(self, number: int | None = None) -> PoseGraph | None:
        """Return the pose graph of a revision, or of the newest (None before the first).

        Raises:
            NotFoundError: no such revision, or `prune` dropped it.
        """
        with self._catalog.read() as connection:
            wanted = _newest(connection) if number is None else int(number)  # SQLite finds no NumPy integer
            if wanted is None:
                return None
            row = connection.execute(select(revisions).where(revisions.c.number == wanted)).first()
            if row is None:
                raise NotFoundError(
                    f"the map has no revision {number}: gsmap list MAP revisions shows the revisions",
                    code="revision_not_found",
                )
            if is_dropped(connection, row):
                raise NotFoundError(
                    f"the poses of revision {number} were deleted by gsmap prune: only its line in the list is left",
                    code="revision_dropped",
                )
            return _pose_graph(connection, row)

    def list(self) -> list[Revision]:
        """Return all revisions, oldest first."""
        with self._catalog.read() as connection:
            return [_revision(row) for row in connection.execute(select(revisions).order_by(revisions.c.number))]

    def entry(self, number: int) -> Revision:
        """Return the history entry of a revision.

        Raises:
            NotFoundError: no such revision.
        """
        with self._catalog.read() as connection:
            row = connection.execute(select(revisions).where(revisions.c.number == int(number))).first()
        if row is None:
            raise NotFoundError(
                f"the map has no revision {number}: gsmap list MAP revisions shows the revisions",
                code="revision_not_found",
            )
        return _revision(row)

    def newest(self) -> Revision | None:
        """Return the history entry of the newest revision; None before the first."""
        with self._catalog.read() as connection:
            row = connection.execute(_NEWEST).first()
        return None if row is None else _revision(row)

    def poses(self, *scenes: str) -> dict[str, ScenePose]:
        """Return the newest poses of some scenes (ids) or of all scenes, without reading edges."""
        newest = poses.c.until.is_(None)
        with self._catalog.read() as connection:
            return _poses(connection, newest & poses.c.scene.in_(scenes) if scenes else newest)

    def world(self) -> tuple[Georeference, ...]:
        """Return the georeferences of the newest revision, for components with observations of the world."""
        with self._catalog.read() as connection:
            row = connection.execute(_NEWEST).first()
        return () if row is None else world_ties_of_json(row.world)

    def outcomes(self, *scenes: str) -> dict[tuple[str, str], EdgeOutcome]:
        """Return the newest outcomes of the edges of some scenes (ids), or of all edges."""
        newest = edges.c.until.is_(None)
        mine = or_(edges.c.target.in_(scenes), edges.c.source.in_(scenes))
        with self._catalog.read() as connection:
            return _outcomes(connection, newest & mine if scenes else newest)

    def changed_after(self, number: int) -> tuple[set[str], set[tuple[str, str]]]:
        """Return scenes whose pose changed after a revision, and (target, source) of edges whose outcome changed."""
        with self._catalog.read() as connection:
            placed = connection.execute(select(poses.c.scene).where(poses.c.until.is_(None), poses.c.since > number))
            judged = select(edges.c.target, edges.c.source).where(edges.c.until.is_(None), edges.c.since > number)
            return set(placed.scalars()), {(row.target, row.source) for row in connection.execute(judged)}

    def tentative(self) -> dict[tuple[str, str], EdgeOutcome]:
        """Return the newest revision's edges that place scenes although no cycle confirms them, by (target, source)."""
        newest = edges.c.until.is_(None) & (edges.c.use == "tentative")
        with self._catalog.read() as connection:
            return dict(_outcomes(connection, newest))

    def undecided(self, number: int | None = None) -> PairsByRevision:
        """Return (target, source) of undecided edges by revision, for one revision or for all."""
        query = select(edges.c.target, edges.c.source, edges.c.since, edges.c.until).where(edges.c.undecided == 1)
        query = query.order_by(edges.c.target, edges.c.source)
        if number is not None:
            query = query.where(_in_revision(edges, number))
        found: PairsByRevision = {}
        with self._catalog.read() as connection:
            end = (_newest(connection) or 0) + 1
            for row in connection.execute(query):
                those = range(row.since, row.until or end) if number is None else (number,)
                for one in those:
                    found.setdefault(one, []).append((row.target, row.source))
        return found


# --- rows with a validity range --------------------------------------------------------------------------------------

_NEWEST = select(revisions).order_by(revisions.c.number.desc()).limit(1)
_ENDS: dict[str, tuple[str, ...]] = {"poses": ("scene",), "edges": ("target", "source")}
RevisionRows = Mapping[str, Mapping[tuple[str, ...], tuple[Any, ...]]]
"""Rows of one revision, by table: the columns after ``until``, by scene or by (target, source)."""
RowSelection = Mapping[str, Collection[tuple[str, ...]]]
"""Selected rows, by table: the scene or (target, source) of each row."""
_FEW = 1000  # scenes named in one query; for more, all rows are read


def insert_revision(connection: Connection, row: Mapping[str, Any], lines: RevisionRows | None) -> None:
    """Insert a revision after the newest, with only those rows that differ from the newest revision.

    Args:
        lines: None for a dropped revision, of which only its entry is left.
    """
    connection.execute(insert(revisions), dict(row) if lines is None else {**row, **_counts_of_lines(lines)})
    if lines is not None:
        _write(connection, row["number"], lines)


def _write(connection: Connection, number: int, lines: RevisionRows, among: RowSelection | None = None) -> None:
    """End the validity of rows that a revision replaces, and insert its new rows.

    Args:
        among: consider only these rows; default: all.
    """
    for table in (poses, edges):
        wanted, current = (
            lines[table.name],
            _current_rows(connection, table, None if among is None else among[table.name]),
        )
        ended = [ends for ends, (_, values) in current.items() if wanted.get(ends) != values]
        begun = [ends for ends, values in wanted.items() if ends not in current or current[ends][1] != values]
        names = _ENDS[table.name]
        if ended:
            mine = [table.c[name] == bindparam(f"_{name}") for name in (*names, "since")]
            connection.execute(
                update(table).where(*mine).values(until=number),
                [
                    {
                        f"_{name}": value
                        for name, value in zip((*names, "since"), (*ends, current[ends][0]), strict=True)
                    }
                    for ends in ended
                ],
            )
        if begun:
            columns = [column.name for column in table.columns]
            made = [dict(zip(columns, (*ends, number, None, *wanted[ends]), strict=True)) for ends in begun]
            connection.execute(insert(table), made)


def _differing(graph: PoseGraph, before: PoseGraph) -> RowSelection:
    """Return the poses and edges of a pose graph that are not the same Python objects in the other."""
    return {
        "poses": {
            (scene,)
            for scene in graph.poses.keys() | before.poses.keys()
            if graph.poses.get(scene) is not before.poses.get(scene)
        },
        "edges": {
            ends
            for ends in graph.outcomes.keys() | before.outcomes.keys()
            if graph.outcomes.get(ends) is not before.outcomes.get(ends)
        },
    }


def rows_of_graph(graph: PoseGraph, among: RowSelection | None = None) -> RevisionRows:
    """Convert a pose graph, or some of its scenes and edges, to rows."""
    return {
        "poses": {
            (scene,): (
                None if pose.S_map_scene is None else pose_bytes(pose.S_map_scene),
                int(pose.component),
                pose.status,
                None if pose.covariance is None else covariance_bytes(pose.covariance),
            )
            for scene, pose in graph.poses.items()
            if among is None or (scene,) in among["poses"]
        },
        "edges": {
            ends: (
                outcome.use,
                None if outcome.residual_chi2 is None else float(outcome.residual_chi2),
                outcome.reason,
                int(outcome.undecided),
            )
            for ends, outcome in graph.outcomes.items()
            if among is None or ends in among["edges"]
        },
    }


def stored_rows(connection: Connection, row: Row[Any]) -> RevisionRows | None:
    """Return the stored rows of a revision; None if they were dropped."""
    if is_dropped(connection, row):
        return None
    return {
        table.name: {
            ends: values
            for ends, (_, values) in _rows(connection, table, _where(connection, table, row.number)).items()
        }
        for table in (poses, edges)
    }


def is_dropped(connection: Connection, row: Row[Any]) -> bool:
    """Return True if `prune` deleted poses or edges of a revision, which it never does for the newest revision."""
    if row.dropped_at is None or row.number == _newest(connection):
        return False
    left = [
        connection.execute(select(func.count()).select_from(table).where(_in_revision(table, row.number))).scalar_one()
        for table in (poses, edges)
    ]
    return left != [row.num_scenes, row.num_used + row.num_tentative + row.num_unused]


def scenes_in_kept_revisions(after: int = 0) -> Select[Any]:
    """Select the scenes that have a pose in any kept revision numbered above ``after``."""
    kept = revisions.c.dropped_at.is_(None) & (revisions.c.number > after)
    return select(poses.c.scene).where(exists().where(kept, holds_in_revision(poses)))


def forget_dropped(connection: Connection) -> None:
    """Delete rows that only dropped revisions use."""
    kept = revisions.c.dropped_at.is_(None) | (revisions.c.number == (_newest(connection) or 0))
    for table in (poses, edges):
        connection.execute(delete(table).where(~exists().where(kept, holds_in_revision(table))))


def holds_in_revision(table: Table) -> ColumnElement[bool]:
    """Return the condition that a row of poses or edges is valid in a row of revisions."""
    return (revisions.c.number >= table.c.since) & or_(table.c.until.is_(None), revisions.c.number < table.c.until)


def _in_revision(table: Table, number: int) -> ColumnElement[bool]:
    return (table.c.since <= number) & or_(table.c.until.is_(None), table.c.until > number)


def _where(connection: Connection, table: Table, number: int) -> ColumnElement[bool]:
    return table.c.until.is_(None) if number == _newest(connection) else _in_revision(table, number)


def _current_rows(
    connection: Connection, table: Table, among: Collection[tuple[str, ...]] | None = None
) -> dict[tuple[str, ...], tuple[int, tuple[Any, ...]]]:
    where, firsts = table.c.until.is_(None), sorted({ends[0] for ends in among or ()})
    if among is None or len(firsts) > _FEW:
        found = _rows(connection, table, where)
    else:
        found = _rows(connection, table, where & table.c[0].in_(firsts))
    return found if among is None else {ends: row for ends, row in found.items() if ends in among}


def _rows(
    connection: Connection, table: Table, where: ColumnElement[bool]
) -> dict[tuple[str, ...], tuple[int, tuple[Any, ...]]]:
    """Return ``since`` and the undecoded values of rows, by scenes."""
    count = len(_ENDS[table.name])
    query = select(*map(_undecoded, table.columns)).where(where).order_by(*table.c[:count])
    return {tuple(row[:count]): (row[count], tuple(row[count + 2 :])) for row in map(tuple, connection.execute(query))}


def _undecoded(column: Any) -> Any:
    """Return a column whose bytes are not decoded, as callers decode many rows at once or no row."""
    return type_coerce(column, LargeBinary).label(column.name) if isinstance(column.type, PackedNumbers) else column


def _counts_of_lines(lines: RevisionRows) -> dict[str, int]:
    placed = [(pose is not None, component) for pose, component, *_ in lines["poses"].values()]
    return _counted(placed, [(use, undecided) for use, _, _, undecided in lines["edges"].values()])


def _counts(graph: PoseGraph) -> dict[str, int]:
    placed = [(pose.S_map_scene is not None, pose.component) for pose in graph.poses.values()]
    return _counted(placed, [(outcome.use, outcome.undecided) for outcome in graph.outcomes.values()])


def _counted(placed: Sequence[tuple[bool, int]], judged: Sequence[tuple[str, int]]) -> dict[str, int]:
    """Count scenes and edges of a revision, from (has pose, component) per scene and (use, undecided) per edge."""
    uses = Counter(use for use, _ in judged)
    counts = (
        len(placed),
        sum(has_pose for has_pose, _ in placed),
        len({component for _, component in placed}),
        uses["used"],
        uses["tentative"],
        uses["unused"],
        sum(undecided for _, undecided in judged),
    )
    return dict(zip(REVISION_COUNTS, counts, strict=True))


def newest_poses(connection: Connection) -> PoseGraph | None:
    """Return the newest pose graph within a transaction; None before the first."""
    row = connection.execute(_NEWEST).first()
    return None if row is None else _pose_graph(connection, row)


def _newest(connection: Connection) -> int | None:
    return connection.execute(select(func.max(revisions.c.number))).scalar()


def _revision(row: Row[Any]) -> Revision:
    return Revision(
        number=row.number,
        created_at=row.created_at,
        note=row.note,
        dropped_at=row.dropped_at,
        key=row.key,
        recipe=row.recipe,
        origin=row.origin,
        settings=row.settings,
        provenance=_provenance(row.provenance),
        notes=tuple(row.notes),
        **{name: getattr(row, name) for name in REVISION_COUNTS},
    )


def _pose_graph(connection: Connection, row: Row[Any]) -> PoseGraph:
    return PoseGraph(
        poses=_poses(connection, _where(connection, poses, row.number)),
        outcomes=_outcomes(connection, _where(connection, edges, row.number)),
        settings=row.settings,
        provenance=_provenance(row.provenance),
        notes=tuple(row.notes),
        world=world_ties_of_json(row.world),
    )


def _poses(connection: Connection, where: ColumnElement[bool]) -> dict[str, ScenePose]:
    query = select(*map(_undecoded, poses.columns)).where(where).order_by(poses.c.scene)
    rows = connection.execute(query).all()
    with malformed_as_corrupt("a value in poses.S_map_scene"):
        S_map_scene = iter(poses_of_bytes([bytes(row.S_map_scene) for row in rows if row.S_map_scene is not None]))
    with malformed_as_corrupt("a value in poses.covariance"):
        covariances = iter(covariances_of_bytes([bytes(row.covariance) for row in rows if row.covariance is not None]))
    none: Any = None
    return {
        scene: ScenePose(
            scene,
            none if pose is None else next(S_map_scene),
            component,
            status,
            None if covariance is None else next(covariances),
        )
        for scene, _, _, pose, component, status, covariance in rows
    }


def _outcomes(connection: Connection, where: ColumnElement[bool]) -> dict[tuple[str, str], EdgeOutcome]:
    query = select(edges).where(where).order_by(edges.c.target, edges.c.source)
    return {
        (target, source): EdgeOutcome(use, residual_chi2, reason, bool(undecided))
        for target, source, _, _, use, residual_chi2, reason, undecided in connection.execute(query).all()
    }


def _provenance(value: dict[str, Any]) -> Provenance:
    known = {part.name: value[part.name] for part in fields(Provenance) if part.name in value}
    priors = known.get("contradicted_priors", [])
    if not isinstance(priors, list) or not all(isinstance(scene, str) for scene in priors):
        raise corrupt_value("revisions.provenance", priors, "a list of ids of scenes")
    return Provenance(**known | {"contradicted_priors": tuple(priors)})

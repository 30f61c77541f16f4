"""Revisions: every answer of the optimiser, numbered from 1, never changed.

What a revision shares with the one before it is kept once: a row of `poses` and `edges` says from which revision on it
holds and up to which (`gsmap.store.schema`). The newest poses are the rows without an end, any other revision's those
around its number, so that reading one costs no chain of others, and forgetting some leaves nothing to be put together.
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
from gsmap.store.columns import Numbers, not_ours
from gsmap.store.matrices import covariance_bytes, covariances_of_bytes, pose_bytes, poses_of_bytes
from gsmap.store.schema import REVISION_COUNTS, edges, poses, revisions
from gsmap.store.ties import tie_value, ties_of
from gsmap.types import EdgeOutcome, PoseGraph, Provenance, ScenePose
from gsmap.types.plain import plain
from gsmap.types.world import Georeference

PairsByRevision = dict[int, list[tuple[str, str]]]


@dataclass(frozen=True)
class Revision:
    """One line of the history.

    Args:
        number: from 1.
        num_scenes, num_placed, num_components: scenes it knows, those with a pose, connected components.
        num_used, num_tentative, num_unused, num_undecided: edges by their outcome (an undecided one counts twice).
            All of these as it was made: what was purged since is counted.
        note: why it was made.
        dropped_at: when `prune` was allowed to reclaim what only it names; None while it is kept.
        key: `RecipeKey.digest` of what it was solved from; one of its own kind in revisions that schema 0001 wrote.
        recipe: digest of its recipe (`gsmap.store.recipes.Recipes.get`); None in those.
        settings, provenance, notes: as of `gsmap.types.PoseGraph`.
        origin: ``map`` (its id) and ``number`` of the revision that another map solved; None where this one did.
    """

    number: int
    created_at: str
    num_scenes: int
    num_placed: int
    num_components: int
    num_used: int = 0
    num_tentative: int = 0
    num_unused: int = 0
    num_undecided: int = 0
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
        """Add a revision; returns its number. All its scenes must be known.

        Args:
            key: its recipe, and all that it was solved from; None where it was not solved but made up.
            note: why it was made.
            after: number and answer of the revision that it was made from. As long as that is the newest, what is the
                very same object in both is not compared again.
        """
        with self._catalog.write() as connection:
            newest = _newest(connection) or 0
            number = 1 + newest
            row = {
                "number": number,
                "key": "" if key is None else key.digest,
                "recipe": recipes.keep(connection, key),
                "settings": plain(graph.settings),
                "provenance": plain(graph.provenance),
                "notes": list(graph.notes),
                "world": [tie_value(tie) for tie in graph.world],
                "note": note,
                "created_at": now(),
            }
            if after is None or after[0] != newest:
                put(connection, row, lines_of(graph))
            else:
                differs = _differing(graph, after[1])
                connection.execute(insert(revisions), {**row, **_counts(graph)})
                _write(connection, number, lines_of(graph, differs), differs)
        return number

    def current(self) -> int | None:
        """The newest revision's number; None before the first."""
        with self._catalog.read() as connection:
            return _newest(connection)

    def get(self, number: int | None = None) -> PoseGraph | None:
        """The answer of a revision, or of the newest (None before the first).

        Raises:
            NotFoundError: no such revision, or `prune` let it go.
        """
        with self._catalog.read() as connection:
            wanted = _newest(connection) if number is None else number
            if wanted is None:
                return None
            row = connection.execute(select(revisions).where(revisions.c.number == wanted)).first()
            if row is None:
                raise NotFoundError(
                    f"no revision {number}: gsmap list MAP revisions shows what there is", code="revision_not_found"
                )
            if is_dropped(connection, row):
                raise NotFoundError(
                    f"revision {number} was dropped by gsmap prune: of it only its line in the list is left",
                    code="revision_dropped",
                )
            return _pose_graph(connection, row)

    def list(self) -> list[Revision]:
        """All revisions, oldest first."""
        with self._catalog.read() as connection:
            return [_revision(row) for row in connection.execute(select(revisions).order_by(revisions.c.number))]

    def one(self, number: int) -> Revision:
        """One line of the history.

        Raises:
            NotFoundError: no such revision.
        """
        with self._catalog.read() as connection:
            row = connection.execute(select(revisions).where(revisions.c.number == number)).first()
        if row is None:
            raise NotFoundError(
                f"no revision {number}: gsmap list MAP revisions shows what there is", code="revision_not_found"
            )
        return _revision(row)

    def newest(self) -> Revision | None:
        """The last line of the history; None before the first."""
        with self._catalog.read() as connection:
            row = connection.execute(_NEWEST).first()
        return None if row is None else _revision(row)

    def poses(self, *scenes: str) -> dict[str, ScenePose]:
        """The newest poses of some scenes (ids), or of all where none is named; no edge is read."""
        newest = poses.c.until.is_(None)
        with self._catalog.read() as connection:
            return _poses(connection, newest & poses.c.scene.in_(scenes) if scenes else newest)

    def world(self) -> tuple[Georeference, ...]:
        """Where the components of the newest revision lie in the world, of those of which anything was observed."""
        with self._catalog.read() as connection:
            row = connection.execute(_NEWEST).first()
        return () if row is None else ties_of(row.world)

    def outcomes(self, *scenes: str) -> dict[tuple[str, str], EdgeOutcome]:
        """What the newest revision made of the edges of some scenes (ids), or of all where none is named."""
        newest = edges.c.until.is_(None)
        mine = or_(edges.c.target.in_(scenes), edges.c.source.in_(scenes))
        with self._catalog.read() as connection:
            return _outcomes(connection, newest & mine if scenes else newest)

    def changed_after(self, number: int) -> tuple[set[str], set[tuple[str, str]]]:
        """The scenes whose newest pose, and the (target, source) of the edges whose outcome, came after a revision."""
        with self._catalog.read() as connection:
            placed = connection.execute(select(poses.c.scene).where(poses.c.until.is_(None), poses.c.since > number))
            judged = select(edges.c.target, edges.c.source).where(edges.c.until.is_(None), edges.c.since > number)
            return set(placed.scalars()), {(row.target, row.source) for row in connection.execute(judged)}

    def tentative(self) -> tuple[tuple[str, str], ...]:
        """Return (target, source) of the newest revision's edges that hold scenes though no cycle confirms them."""
        newest = edges.c.until.is_(None) & (edges.c.use == "tentative")
        with self._catalog.read() as connection:
            return tuple(_outcomes(connection, newest))

    def undecided(self, number: int | None = None) -> PairsByRevision:
        """(target, source) of the edges that nothing could decide, by revision; of one revision or of all."""
        query = select(edges.c.target, edges.c.source, edges.c.since, edges.c.until).where(edges.c.undecided == 1)
        query = query.order_by(edges.c.target, edges.c.source)
        if number is not None:
            query = query.where(_holds(edges, number))
        found: PairsByRevision = {}
        with self._catalog.read() as connection:
            end = (_newest(connection) or 0) + 1
            for row in connection.execute(query):
                those = range(row.since, row.until or end) if number is None else (number,)
                for one in those:
                    found.setdefault(one, []).append((row.target, row.source))
        return found


# --- rows that hold for a while --------------------------------------------------------------------------------------

_NEWEST = select(revisions).order_by(revisions.c.number.desc()).limit(1)
_ENDS: dict[str, tuple[str, ...]] = {"poses": ("scene",), "edges": ("target", "source")}
Lines = Mapping[str, Mapping[tuple[str, ...], tuple[Any, ...]]]
"""Of each table the rows of one revision: what follows ``until``, by scene, or by target and source."""
Among = Mapping[str, Collection[tuple[str, ...]]]
"""Of each table the scene, or target and source, of some rows."""
_FEW = 1000  # scenes that one query names; beyond, all rows are read


def put(connection: Connection, row: Mapping[str, Any], lines: Lines | None) -> None:
    """Add a revision, numbered after the newest: of its lines only those are written that differ from that one's.

    Args:
        lines: None of one that was dropped elsewhere, of which no more is left than its row.
    """
    connection.execute(insert(revisions), dict(row) if lines is None else {**row, **_counts_of_lines(lines)})
    if lines is not None:
        _write(connection, row["number"], lines)


def _write(connection: Connection, number: int, lines: Lines, among: Among | None = None) -> None:
    """End the rows that no longer hold from a revision on, and add those that begin to.

    Args:
        among: only these may do so; all where None.
    """
    for table in (poses, edges):
        wanted, standing = lines[table.name], _standing(connection, table, None if among is None else among[table.name])
        ended = [ends for ends, (_, values) in standing.items() if wanted.get(ends) != values]
        begun = [ends for ends, values in wanted.items() if ends not in standing or standing[ends][1] != values]
        names = _ENDS[table.name]
        if ended:
            mine = [table.c[name] == bindparam(f"_{name}") for name in (*names, "since")]
            connection.execute(
                update(table).where(*mine).values(until=number),
                [
                    {
                        f"_{name}": value
                        for name, value in zip((*names, "since"), (*ends, standing[ends][0]), strict=True)
                    }
                    for ends in ended
                ],
            )
        if begun:
            columns = [column.name for column in table.columns]
            made = [dict(zip(columns, (*ends, number, None, *wanted[ends]), strict=True)) for ends in begun]
            connection.execute(insert(table), made)


def _differing(graph: PoseGraph, before: PoseGraph) -> Among:
    """What two answers do not share as the very same objects."""
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


def lines_of(graph: PoseGraph, among: Among | None = None) -> Lines:
    """What a revision's tables hold of an answer, or of some of its scenes and edges."""
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


def stored_lines(connection: Connection, row: Row[Any]) -> Lines | None:
    """What the tables hold of a revision; None of one that was dropped."""
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
    """Whether `prune` took poses or edges of a revision. The newest one's are those of the map, and stay."""
    if row.dropped_at is None or row.number == _newest(connection):
        return False
    left = [
        connection.execute(select(func.count()).select_from(table).where(_holds(table, row.number))).scalar_one()
        for table in (poses, edges)
    ]
    return left != [row.num_scenes, row.num_used + row.num_tentative + row.num_unused]


def named_by_kept(after: int = 0) -> Select[Any]:
    """The scenes that have a pose in any revision that was not dropped, of those numbered after one."""
    kept = revisions.c.dropped_at.is_(None) & (revisions.c.number > after)
    return select(poses.c.scene).where(exists().where(kept, holds_in_revision(poses)))


def forget_dropped(connection: Connection) -> None:
    """Delete what only dropped revisions hold."""
    kept = revisions.c.dropped_at.is_(None) | (revisions.c.number == (_newest(connection) or 0))
    for table in (poses, edges):
        connection.execute(delete(table).where(~exists().where(kept, holds_in_revision(table))))


def holds_in_revision(table: Table) -> ColumnElement[bool]:
    """That a row of poses or edges holds in a row of revisions."""
    return (revisions.c.number >= table.c.since) & or_(table.c.until.is_(None), revisions.c.number < table.c.until)


def _holds(table: Table, number: int) -> ColumnElement[bool]:
    return (table.c.since <= number) & or_(table.c.until.is_(None), table.c.until > number)


def _where(connection: Connection, table: Table, number: int) -> ColumnElement[bool]:
    return table.c.until.is_(None) if number == _newest(connection) else _holds(table, number)


def _standing(
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
    """`since` and values, bytes as they lie, by scenes."""
    count = len(_ENDS[table.name])
    query = select(*map(_as_it_lies, table.columns)).where(where).order_by(*table.c[:count])
    return {tuple(row[:count]): (row[count], tuple(row[count + 2 :])) for row in map(tuple, connection.execute(query))}


def _as_it_lies(column: Any) -> Any:
    """A column whose bytes are not taken apart: many are at once, or none."""
    return type_coerce(column, LargeBinary).label(column.name) if isinstance(column.type, Numbers) else column


def _counts_of_lines(lines: Lines) -> dict[str, int]:
    placed = [(pose is not None, component) for pose, component, *_ in lines["poses"].values()]
    return _counted(placed, [(use, undecided) for use, _, _, undecided in lines["edges"].values()])


def _counts(graph: PoseGraph) -> dict[str, int]:
    placed = [(pose.S_map_scene is not None, pose.component) for pose in graph.poses.values()]
    return _counted(placed, [(outcome.use, outcome.undecided) for outcome in graph.outcomes.values()])


def _counted(placed: Sequence[tuple[bool, int]], judged: Sequence[tuple[str, int]]) -> dict[str, int]:
    """What a revision knows of itself: of whether each scene has a pose, and its component; of edges' uses."""
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
    """The newest revision's answer, as a transaction sees it; None before the first."""
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
        world=ties_of(row.world),
    )


def _poses(connection: Connection, where: ColumnElement[bool]) -> dict[str, ScenePose]:
    query = select(*map(_as_it_lies, poses.columns)).where(where).order_by(poses.c.scene)
    rows = connection.execute(query).all()
    with not_ours("poses.S_map_scene"):
        S_map_scene = iter(poses_of_bytes([bytes(row.S_map_scene) for row in rows if row.S_map_scene is not None]))
    with not_ours("poses.covariance"):
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


def _provenance(said: dict[str, Any]) -> Provenance:
    known = {part.name: said[part.name] for part in fields(Provenance) if part.name in said}
    return Provenance(**known | {"contradicted_priors": tuple(known.get("contradicted_priors", ()))})

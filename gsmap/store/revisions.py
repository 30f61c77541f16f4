"""Revisions: every answer of the optimiser, numbered from 1, never changed."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from sqlalchemy import Connection, Row, Select, case, func, insert, select

from gsmap.errors import NotFoundError
from gsmap.methods import RecipeKey
from gsmap.store import recipes
from gsmap.store.catalog import Catalog, now
from gsmap.store.matrices import from_array, from_pose, to_array, to_pose
from gsmap.store.schema import edges, poses, revisions
from gsmap.types import EdgeOutcome, PoseGraph, Provenance, ScenePose
from gsmap.types.plain import plain


@dataclass(frozen=True)
class Revision:
    """One line of the history.

    Args:
        number: from 1.
        num_scenes, num_placed, num_components: scenes it knows, those with a pose, connected components.
        num_used, num_tentative, num_unused, num_undecided: edges by their outcome (an undecided one counts twice).
        note: why it was made.
        dropped_at: when `prune` was allowed to reclaim what only it names; None while it is kept.
        key: `RecipeKey.digest` of what it was solved from; one of its own kind in revisions that schema 0001 wrote.
        recipe: digest of its recipe (`gsmap.store.recipes.Recipes.get`); None in those.
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


class Revisions:
    """The pose graphs of a map."""

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog

    def save(self, graph: PoseGraph, key: RecipeKey | None = None, note: str = "") -> int:
        """Add a revision; returns its number. All its scenes must be known.

        Args:
            key: its recipe, and all that it was solved from; None where it was not solved but made up.
            note: why it was made.
        """
        with self._catalog.write() as connection:
            number = 1 + (connection.execute(select(func.max(revisions.c.number))).scalar() or 0)
            row = {
                "number": number,
                "key": "" if key is None else key.digest,
                "recipe": recipes.keep(connection, key),
                "settings": plain(graph.settings),
                "provenance": plain(graph.provenance),
                "notes": list(graph.notes),
                "note": note,
                "created_at": now(),
            }
            connection.execute(insert(revisions), row)
            pose_rows = [
                {
                    "revision": number,
                    "scene": scene,
                    "S_map_scene": from_pose(pose.S_map_scene),
                    "component": int(pose.component),
                    "status": pose.status,
                    "covariance": from_array(pose.covariance),
                }
                for scene, pose in graph.poses.items()
            ]
            edge_rows = [
                {
                    "revision": number,
                    "target": target,
                    "source": source,
                    "use": outcome.use,
                    "residual_chi2": None if outcome.residual_chi2 is None else float(outcome.residual_chi2),
                    "reason": outcome.reason,
                    "undecided": int(outcome.undecided),
                }
                for (target, source), outcome in graph.outcomes.items()
            ]
            if pose_rows:
                connection.execute(insert(poses), pose_rows)
            if edge_rows:
                connection.execute(insert(edges), edge_rows)
        return number

    def current(self) -> int | None:
        """The newest revision's number; None before the first."""
        with self._catalog.read() as connection:
            return _newest(connection)

    def get(self, number: int | None = None) -> PoseGraph | None:
        """The answer of a revision, or of the newest (None before the first).

        Raises:
            NotFoundError: no such revision.
        """
        with self._catalog.read() as connection:
            wanted = _newest(connection) if number is None else number
            if wanted is None:
                return None
            row = connection.execute(select(revisions).where(revisions.c.number == wanted)).first()
            if row is None:
                raise NotFoundError(f"no revision {number}: gsmap list MAP revisions shows what there is")
            return _pose_graph(connection, row)

    def find(self, key: RecipeKey | str) -> int | None:
        """Number of the newest revision that was solved from exactly this; None where there is none."""
        same = revisions.c.key == recipes.digest_of(key)
        with self._catalog.read() as connection:
            return connection.execute(select(func.max(revisions.c.number)).where(same)).scalar()

    def list(self) -> list[Revision]:
        """All revisions, oldest first."""
        query = (
            select(
                revisions,
                func.count(poses.c.scene).label("num_scenes"),
                func.count(poses.c.S_map_scene).label("num_placed"),
                func.count(poses.c.component.distinct()).label("num_components"),
            )
            .outerjoin(poses, poses.c.revision == revisions.c.number)
            .group_by(revisions.c.number)
            .order_by(revisions.c.number)
        )
        with self._catalog.read() as connection:
            counts: dict[int, Row[Any]] = {row.revision: row for row in connection.execute(_EDGE_COUNTS)}
            return [_revision(row, counts.get(row.number)) for row in connection.execute(query)]


def newest_poses(connection: Connection) -> PoseGraph | None:
    """The newest revision's answer, as a transaction sees it; None before the first."""
    row = connection.execute(select(revisions).order_by(revisions.c.number.desc()).limit(1)).first()
    return None if row is None else _pose_graph(connection, row)


def _is(condition: Any) -> Any:
    return func.sum(case((condition, 1), else_=0))


_EDGE_COUNTS: Select[Any] = select(
    edges.c.revision,
    _is(edges.c.use == "used").label("num_used"),
    _is(edges.c.use == "tentative").label("num_tentative"),
    _is(edges.c.use == "unused").label("num_unused"),
    func.sum(edges.c.undecided).label("num_undecided"),
).group_by(edges.c.revision)


def _newest(connection: Connection) -> int | None:
    return connection.execute(select(func.max(revisions.c.number))).scalar()


def _revision(row: Row[Any], count: Row[Any] | None) -> Revision:
    return Revision(
        number=row.number,
        created_at=row.created_at,
        num_scenes=row.num_scenes,
        num_placed=row.num_placed,
        num_components=row.num_components,
        num_used=0 if count is None else int(count.num_used),
        num_tentative=0 if count is None else int(count.num_tentative),
        num_unused=0 if count is None else int(count.num_unused),
        num_undecided=0 if count is None else int(count.num_undecided),
        note=row.note,
        dropped_at=row.dropped_at,
        key=row.key,
        recipe=row.recipe,
        origin=row.origin,
    )


def _pose_graph(connection: Connection, row: Row[Any]) -> PoseGraph:
    placed = {
        p.scene: ScenePose(p.scene, to_pose(p.S_map_scene), p.component, p.status, to_array(p.covariance))
        for p in connection.execute(select(poses).where(poses.c.revision == row.number))
    }
    lines = connection.execute(select(edges).where(edges.c.revision == row.number))
    return PoseGraph(
        poses=placed,
        outcomes={(e.target, e.source): _outcome(e) for e in lines},
        settings=row.settings,
        provenance=_provenance(row.provenance),
        notes=tuple(row.notes),
    )


def _outcome(row: Row[Any]) -> EdgeOutcome:
    return EdgeOutcome(row.use, row.residual_chi2, row.reason, bool(row.undecided))


def _provenance(said: dict[str, Any]) -> Provenance:
    known = {part.name: said[part.name] for part in fields(Provenance) if part.name in said}
    return Provenance(**known | {"contradicted_priors": tuple(known.get("contradicted_priors", ()))})

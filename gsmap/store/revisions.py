"""Revisions: every answer of the optimiser, numbered from 1, never changed."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import Connection, Row, func, insert, select

from gsmap.errors import NotFoundError
from gsmap.store.catalog import Catalog, now
from gsmap.store.matrices import from_array, from_pose, plain, to_array, to_pose
from gsmap.store.schema import edges, poses, revisions
from gsmap.types import PoseGraph, ScenePose


@dataclass(frozen=True)
class Revision:
    """One line of the history.

    Args:
        number: from 1.
        num_scenes, num_placed, num_components: scenes it knows, those with a pose, islands.
        note: why it was made.
        dropped_at: when `prune` was allowed to reclaim what only it names; None while it is kept.
    """

    number: int
    created_at: str
    num_scenes: int
    num_placed: int
    num_components: int
    note: str = ""
    dropped_at: str | None = None


class Revisions:
    """The pose graphs of a map."""

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog

    def save(self, graph: PoseGraph, note: str = "") -> int:
        """Add a revision; returns its number. All its scenes must be known."""
        with self._catalog.write() as connection:
            number = 1 + (connection.execute(select(func.max(revisions.c.number))).scalar() or 0)
            row = {"number": number, "parameters": plain(graph.parameters), "undecided": plain(graph.undecided)}
            connection.execute(insert(revisions), row | {"note": note, "created_at": now()})
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
                    "used": plain(graph.used.get((target, source))),
                    "residual": _number(graph.residuals.get((target, source))),
                    "reason": graph.reasons.get((target, source)),
                }
                for target, source in dict.fromkeys([*graph.used, *graph.residuals, *graph.reasons])
            ]
            if pose_rows:
                connection.execute(insert(poses), pose_rows)
            if edge_rows:
                connection.execute(insert(edges), edge_rows)
        return number

    def current(self) -> int | None:
        """The newest revision's number; None before the first."""
        with self._catalog.read() as connection:
            return connection.execute(select(func.max(revisions.c.number))).scalar()

    def get(self, number: int | None = None) -> PoseGraph | None:
        """The answer of a revision, or of the newest (None before the first).

        Raises:
            NotFoundError: no such revision.
        """
        with self._catalog.read() as connection:
            wanted = number
            if wanted is None:
                wanted = connection.execute(select(func.max(revisions.c.number))).scalar()
                if wanted is None:
                    return None
            row = connection.execute(select(revisions).where(revisions.c.number == wanted)).first()
            if row is None:
                raise NotFoundError(f"no revision {number}: gsmap list MAP revisions shows what there is")
            return _pose_graph(connection, row)

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
            return [
                Revision(r.number, r.created_at, r.num_scenes, r.num_placed, r.num_components, r.note, r.dropped_at)
                for r in connection.execute(query)
            ]


def _number(value: float | None) -> float | None:
    return None if value is None else float(value)


def _pose_graph(connection: Connection, row: Row) -> PoseGraph:
    placed = {
        p.scene: ScenePose(p.scene, to_pose(p.S_map_scene), p.component, p.status, to_array(p.covariance))
        for p in connection.execute(select(poses).where(poses.c.revision == row.number))
    }
    lines = connection.execute(select(edges).where(edges.c.revision == row.number)).all()
    return PoseGraph(
        poses=placed,
        used={(e.target, e.source): e.used for e in lines if e.used is not None},
        residuals={(e.target, e.source): e.residual for e in lines if e.residual is not None},
        reasons={(e.target, e.source): e.reason for e in lines if e.reason is not None},
        undecided=tuple((a, b) for a, b in row.undecided),
        parameters=row.parameters,
    )

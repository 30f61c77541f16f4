"""Look up all scenes, graphs and their files at once, so that reading many of them needs no statement for each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Engine, Row, select, union

from gsmap.store.arrays import StoredFile
from gsmap.store.catalog import Catalog
from gsmap.store.result_rows import GRAPHS
from gsmap.store.schema import files, scenes


@dataclass(frozen=True, eq=False)
class CatalogRows:
    """Rows of one catalog.

    Args:
        engine: of the catalog.
        scenes: living scenes by id.
        graphs: graphs of each of these, oldest first, by scene id.
        files: files of their array groups by group id.
    """

    engine: Engine
    scenes: dict[str, Row[Any]]
    graphs: dict[str, list[Row[Any]]]
    files: dict[str, tuple[StoredFile, ...]]


_located: ContextVar[CatalogRows | None] = ContextVar("located", default=None)


@contextmanager
def locate_all(catalog: Catalog) -> Iterator[None]:
    """Look up the living scenes of a map, for reads inside, which then all see the map as it is now.

    Only reads belong inside: they share one read transaction, and what this process writes there is not seen.
    """
    living = select(scenes.c.id).where(scenes.c.removed_at.is_(None))
    of_living = GRAPHS.c.scene.in_(living)
    wanted = union(
        select(scenes.c.group_id).where(scenes.c.removed_at.is_(None)),
        GRAPHS.select(GRAPHS.c.group_id).where(of_living),
    )
    with catalog.read() as connection:
        rows = connection.execute(select(scenes).where(scenes.c.removed_at.is_(None))).all()
        described = connection.execute(GRAPHS.select().where(of_living).order_by(GRAPHS.c.created_at)).all()
        held = connection.execute(
            select(files).where(files.c.group_id.in_(wanted)).order_by(files.c.group_id, files.c.path)
        ).all()
        of_scene: dict[str, list[Row[Any]]] = {row.id: [] for row in rows}
        for row in described:
            of_scene[row.scene].append(row)
        groups: dict[str, list[StoredFile]] = {}
        for row in held:
            groups.setdefault(row.group_id, []).append(StoredFile(row.path, row.size_bytes, row.sha256))
        of_group = {group_id: tuple(own) for group_id, own in groups.items()}
        token = _located.set(CatalogRows(connection.engine, {row.id: row for row in rows}, of_scene, of_group))
        try:
            yield
        finally:
            _located.reset(token)


def _known(connection: Connection) -> CatalogRows | None:
    found = _located.get()
    return found if found is not None and found.engine is connection.engine else None


def located_scene(connection: Connection, scene: str) -> Row[Any] | None:
    """Return the row of a living scene by its id; None if scenes were not looked up."""
    found = _known(connection)
    return None if found is None else found.scenes.get(scene)


def located_graphs(connection: Connection, scene: str) -> Sequence[Row[Any]] | None:
    """Return the graphs of a living scene, oldest first; None if scenes were not looked up."""
    found = _known(connection)
    return None if found is None else found.graphs.get(scene)


def located_files(connection: Connection, group_id: str) -> tuple[StoredFile, ...] | None:
    """Return the files of an array group; None if they were not looked up."""
    found = _known(connection)
    return None if found is None else found.files.get(group_id)

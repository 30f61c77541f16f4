"""Copy a catalog between databases: SQLite files and PostgreSQL servers."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from sqlalchemy import Column, Connection, Double, Engine, Integer, MetaData, Table, delete, select, text, update
from sqlalchemy.types import TypeDecorator

from gsmap.errors import ConfigError, GsmapError, StoreError
from gsmap.store import catalog as _catalog
from gsmap.store import migrate, schema, sqlite, trust
from gsmap.store.catalog import Catalog
from gsmap.store.error_translation import translate_errors
from gsmap.store.schema import CHUNK_BOXES

_log = logging.getLogger("gsmap.store")

BATCH_ROWS = 2000  # rows in memory at a time; a pose with covariance takes some kilobytes

# The R*Tree of SQLite and the plain table elsewhere, by the columns that both have.
_BOXES = Table(
    CHUNK_BOXES,
    MetaData(),
    Column("id", Integer, primary_key=True),
    *(Column(name, Integer) for name in ("s0", "s1")),
    *(Column(name, Double) for name in ("x0", "x1", "y0", "y1", "z0", "z1")),
    Column("chunk", Integer),
)


def empty_catalog(folder: Path, url: str | None = None, map_id: str = "") -> Catalog:
    """Create empty tables in a new ``map.sqlite``, or in an empty database at ``url``.

    Args:
        map_id: id of the map that a database is for.

    Raises:
        StoreError: the database already holds a map.
        ConfigError: the database does not store its texts as UTF-8.
    """
    if url is None:
        sqlite.create_file(folder / sqlite.FILE)
        made = open_sqlite_catalog(folder)
    else:
        engine = _catalog.url_engine(url)
        _require_utf8(engine)
        if migrate.version(engine, folder) is not None:
            raise StoreError(
                f"the database {engine.url!r} holds a map already: give each map a database of its own",
                code="database_not_empty",
            )
        trust.write(folder, _catalog.url_without_password(url), map_id)
        made = Catalog(folder, engine, writable=True)
    migrate.upgrade(made)
    return made


def drop_tables(folder: Path, url: str) -> None:
    """Drop the tables of `empty_catalog` from a database whose map could not be made."""
    catalog = Catalog(folder, _catalog.url_engine(url), writable=True)
    try:
        migrate.upgrade(catalog, "base")
        with translate_errors(catalog.folder), catalog.engine.begin() as connection:
            connection.execute(text("DROP TABLE alembic_version"))
    except GsmapError as error:
        _log.warning(
            "the database %r still has the tables of a map that was not made (drop them by hand): %s",
            catalog.engine.url,
            error,
        )
    finally:
        catalog.close()


def _require_utf8(engine: Engine) -> None:
    """Raise an error for a database of another encoding; SQLAlchemy fails on its texts, which are bytes."""
    positional, named = engine.dialect.create_connect_args(engine.url)
    try:
        with contextlib.closing(engine.dialect.connect(*positional, **named)) as connection:
            encoding = connection.info.parameter_status("server_encoding")
    except engine.dialect.loaded_dbapi.Error:
        return  # a server that cannot be reached is reported by the first query
    if encoding != "UTF8":
        raise ConfigError(
            f"the database {engine.url!r} has the encoding {encoding}, but a catalog needs UTF8: create it with "
            "CREATE DATABASE name TEMPLATE template0 ENCODING 'UTF8'",
            code="unsupported_encoding",
        )


def open_sqlite_catalog(folder: Path) -> Catalog:
    """Open the ``map.sqlite`` of a map under construction for writing."""
    return Catalog(folder, sqlite.engine(folder / sqlite.FILE, writable=True), writable=True)


def make_independent(folder: Path, empty: Collection[Table], **about: Any) -> None:
    """Make a copied ``map.sqlite`` the catalog of another map, whose revisions name the original map as their origin.

    Args:
        empty: tables that belong to the original map alone.
        about: changed columns of the row about the map, such as ``id``.
    """
    revisions = schema.revisions
    with contextlib.closing(open_sqlite_catalog(folder)) as catalog, catalog.write() as connection:
        before = connection.execute(select(schema.about.c.id)).scalar_one()
        connection.execute(update(schema.about).values(**about))
        solved = select(revisions.c.number).where(revisions.c.origin.is_(None))
        for number in connection.execute(solved).scalars().all():
            origin = {"map": before, "number": number}
            connection.execute(update(revisions).where(revisions.c.number == number).values(origin=origin))
        for table in empty:
            connection.execute(delete(table))


def copy_catalog(source: Catalog, target: Catalog, *, leave_out: Collection[str] = ()) -> dict[str, int]:
    """Copy all rows of all tables to a new catalog (`empty_catalog`), in one transaction of each catalog.

    The copy is a snapshot of the source and blocks no other process. Chunk boxes have 32 bits in SQLite's R*Tree and 64
    elsewhere: they widen by rounding on the way into the tree.

    Args:
        leave_out: names of tables whose rows are not copied.

    Returns:
        Number of rows copied, by table.

    Raises:
        StoreError: the schemas differ, or the target already holds rows.
    """
    versions = [migrate.version(one.engine, one.folder) for one in (source, target)]
    if versions[0] != versions[1]:
        raise StoreError(
            f"{source.folder} has schema {versions[0]}, but the catalog to copy it to has schema {versions[1]}: "
            "run gsmap migrate",
            code="schema_mismatch",
        )
    with snapshot_read(source) as reading, target.write() as writing:
        return copy_rows(reading, writing, leave_out=leave_out)


def copy_rows(source: Connection, target: Connection, *, leave_out: Collection[str] = ()) -> dict[str, int]:
    """Copy rows like `copy_catalog`, but in transactions of the caller; ``source`` must be a `snapshot_read`."""
    counts = {}
    for table in tables():
        if target.execute(select(text("1")).select_from(table).limit(1)).first() is not None:
            raise StoreError(
                f"the catalog to copy to already has rows in {table.name}: name an empty database",
                code="database_not_empty",
            )
        counts[table.name] = 0 if table.name in leave_out else _copy_table(source, target, table)
    _set_counters(target)
    return counts


@contextlib.contextmanager
def snapshot_read(catalog: Catalog) -> Iterator[Connection]:
    """Open a reading transaction that sees one committed state from its first statement to its last."""
    options = {} if catalog.is_sqlite else {"isolation_level": "REPEATABLE READ", "postgresql_readonly": True}
    with translate_errors(catalog.folder), catalog.engine.execution_options(**options).begin() as connection:
        yield connection


def tables() -> list[Table]:
    """Return all tables except ``alembic_version`` in the order of references, with undecoded texts."""
    return [_plain(table) for table in schema.metadata.sorted_tables] + [_BOXES]


def _plain(table: Table) -> Table:
    columns = [(c, c.type.impl_instance if isinstance(c.type, TypeDecorator) else c.type) for c in table.columns]
    return Table(table.name, MetaData(), *(Column(c.name, kind, primary_key=c.primary_key) for c, kind in columns))


def _copy_table(source: Connection, target: Connection, table: Table) -> int:
    count = 0
    query = select(table).order_by(*table.primary_key.columns)
    found = source.execute(query, execution_options={"yield_per": BATCH_ROWS})
    for batch in found.mappings().partitions():
        rows = [dict(row) for row in batch]
        if table is _BOXES:  # the R*Tree gives whole numbers as floats
            rows = [row | {name: int(row[name]) for name in ("s0", "s1")} for row in rows]
        target.execute(table.insert(), rows)
        count += len(rows)
    return count


def _set_counters(connection: Connection) -> None:
    """Advance the key counters of PostgreSQL past the copied rows."""
    if connection.dialect.name != "postgresql":
        return
    for table in tables():
        first, *more = table.primary_key.columns
        if more or not isinstance(first.type, Integer):
            continue
        names = {"t": table.name, "c": first.name}
        counter = connection.execute(text("SELECT pg_get_serial_sequence(:t, :c)"), names).scalar()
        if counter is not None:
            top = f'SELECT setval(:s, (SELECT coalesce(max("{first.name}"), 0) + 1 FROM "{table.name}"), false)'
            connection.execute(text(top), {"s": counter})

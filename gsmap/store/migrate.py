"""Run the schema migrations of ``migrations/`` (in the wheel ``gsmap/migrations``)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from sqlalchemy import Connection, Engine, inspect, text

from gsmap.errors import CorruptError, SchemaVersionError, StoreError
from gsmap.store import schema, sqlite
from gsmap.store.catalog import Catalog, commit
from gsmap.store.error_translation import NOT_KEPT, translate_errors
from gsmap.version import __version__

if TYPE_CHECKING:
    from alembic.config import Config


def version(engine: Engine, folder: Path) -> str | None:
    """Return the schema version of a database; None for an empty database."""
    with translate_errors(folder), engine.connect() as connection:
        return _version(connection)


def _version(connection: Connection) -> str | None:
    if not inspect(connection).has_table("alembic_version"):
        return None
    return connection.execute(text("SELECT version_num FROM alembic_version")).scalar()


def require_current(catalog: Catalog) -> None:
    """Raise an error unless a database has the current schema.

    Raises:
        SchemaVersionError: the schema is newer (get a newer gsmap) or older (``gsmap migrate``).
        CorruptError: there is no schema, or tables that gsmap did not make.
    """
    folder = catalog.folder
    with catalog.read() as connection:
        found = _version(connection)
    if found is None:
        raise CorruptError(
            f"{folder}: its catalog holds no gsmap tables; restore it from a backup", code="catalog_invalid"
        )
    if found > schema.HEAD:
        raise SchemaVersionError(
            f"{folder} was written by a newer gsmap (schema {found}; this gsmap {__version__} supports up to "
            f"{schema.HEAD}): upgrade gsmap",
            code="map_too_new",
        )
    if found < schema.HEAD:
        _require_released(folder, found)
        raise SchemaVersionError(
            f"{folder} was written by an older gsmap (schema {found}, now {schema.HEAD}): run gsmap migrate {folder}",
            code="map_too_old",
        )
    if catalog.is_sqlite:  # a server belongs to the user and is trusted
        with catalog.read() as connection:
            _require_tables(connection, folder)


def _require_released(folder: Path, found: str) -> None:
    if found < schema.FIRST:
        raise SchemaVersionError(
            f"{folder} was written by a development version of gsmap (schema {found}) that was never released: ingest "
            "its captures into a new map",
            code="map_not_released",
        )


def _require_tables(connection: Connection, folder: Path) -> None:
    """Raise an error if the tables of a file differ from the schema.

    Rows are trusted for their column types, and a trigger or a view would change what gsmap's statements do.
    """
    extra = connection.execute(text("SELECT type, name FROM sqlite_master WHERE type IN ('trigger', 'view')")).first()
    if extra is not None:
        raise _not_ours(folder, f"has a {extra.type} ({extra.name!r})")
    strict = {row.name: bool(row.strict) for row in connection.execute(text("PRAGMA table_list"))}
    for name, table in schema.metadata.tables.items():
        if not strict.get(name):
            raise _not_ours(folder, f"has no table {name!r} with strict column types")
        found = {
            row.name: (row.type, bool(row.notnull), row.hidden)
            for row in connection.execute(text(f"PRAGMA table_xinfo({name})"))
        }
        wanted = {c.name: (c.type.compile(connection.dialect), not c.nullable, 0) for c in table.columns}
        if found != wanted:
            odd = sorted(column for column in {*found, *wanted} if found.get(column) != wanted.get(column))
            raise _not_ours(folder, f"has an unexpected column {name}.{odd[0]}")


def _not_ours(folder: Path, what: str) -> CorruptError:
    return CorruptError(
        f"{folder}: its catalog {what}, which gsmap does not write: restore it from a backup, and do not trust the map "
        "if you received it like this",
        code="catalog_invalid",
    )


def upgrade(catalog: Catalog, revision: str = "head") -> tuple[str | None, str | None]:
    """Migrate the tables to a schema version in one transaction; return the versions before and after.

    An existing SQLite catalog is first copied to ``map.sqlite.VERSION.bak``.

    Raises:
        SchemaVersionError: the database is newer than this gsmap, or older than its first release.
    """
    before = version(catalog.engine, catalog.folder)
    if before is not None and before > schema.HEAD:
        require_current(catalog)
    if before is not None:
        _require_released(catalog.folder, before)
    if before == schema.HEAD and revision == "head":
        return before, before
    with catalog.lock():
        if before is not None and catalog.is_sqlite:
            with translate_errors(catalog.folder, NOT_KEPT):
                catalog.copy(catalog.folder / f"{sqlite.FILE}.{before}.bak")
        with translate_errors(catalog.folder, NOT_KEPT), catalog.engine.connect() as connection:
            if catalog.is_sqlite:
                # Batch migrations rebuild tables, which foreign keys would forbid; checked before the commit.
                _driver(connection).execute("PRAGMA foreign_keys = OFF")
            try:
                with connection.execution_options(gsmap_write=True).begin() as transaction:
                    _run(connection, revision)
                    if catalog.is_sqlite and connection.exec_driver_sql("PRAGMA foreign_key_check").first():
                        raise StoreError(
                            f"{catalog.folder}: the migration would break references, so it was undone; the map "
                            "is unchanged",
                            code="migration_breaks_references",
                        )
                    with translate_errors(catalog.folder, NOT_KEPT, committing=True):
                        commit(connection, transaction)
            finally:
                if catalog.is_sqlite and not connection.invalidated:
                    _driver(connection).execute("PRAGMA foreign_keys = ON")
    return before, version(catalog.engine, catalog.folder)


def config() -> Config:
    """Return Alembic's configuration, without a file."""
    from alembic.config import Config

    out = Config()
    out.set_main_option("script_location", str(folder()).replace("%", "%%"))
    return out


def folder() -> Path:
    """Return the folder of the migrations: inside the installed package, or beside it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    for place in (package / "migrations", package.parent / "migrations"):
        if (place / "env.py").is_file():
            return place
    raise StoreError(f"{package} was installed without its migrations: reinstall gsmap", code="no_migrations")


def _driver(connection: Connection) -> Any:
    return connection.connection.driver_connection


def _run(connection: Connection, revision: str) -> None:
    from alembic import command

    settings = config()
    settings.attributes["connection"] = connection
    down = revision == "base" or (revision != "head" and revision < (_current(connection) or ""))
    (command.downgrade if down else command.upgrade)(settings, revision)


def _current(connection: Connection) -> str | None:
    from alembic.runtime.migration import MigrationContext

    return MigrationContext.configure(connection).get_current_revision()

"""What is particular to SQLite: how a connection is opened, how a transaction begins, when the log is folded in."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Engine, create_engine, event

from gsmap.errors import StoreError

FILE = "map.sqlite"
CHECKPOINT_BYTES = 4 << 20


def engine(file: Path, *, writable: bool) -> Engine:
    """An engine on one file: WAL, full synchronisation, foreign keys, transactions that we begin ourselves.

    Write transactions (`WRITE` in the execution options) begin IMMEDIATE: a deferred one that turns into a writer
    fails at once when another has written meanwhile, whatever the busy timeout.
    """
    uri = f"{file.resolve().as_uri()}?mode={'rw' if writable else 'ro'}"
    if not writable and _on_read_only_disk(file):
        # A WAL reader must write its index; on a disk where nobody can write nothing can change either.
        uri += "&immutable=1"

    def connect() -> sqlite3.Connection:
        connection = sqlite3.connect(uri, uri=True, timeout=60.0, isolation_level=None, check_same_thread=False)
        connection.execute("PRAGMA foreign_keys = ON")
        connection.execute("PRAGMA synchronous = FULL")
        connection.execute("PRAGMA wal_autocheckpoint = 0")  # `checkpoint` does it under the writer lock
        connection.execute("PRAGMA trusted_schema = OFF")
        return connection

    made = create_engine("sqlite://", creator=connect)

    @event.listens_for(made, "begin")
    def begin(connection: Connection) -> None:
        write = connection.get_execution_options().get("gsmap_write", False)
        connection.exec_driver_sql("BEGIN IMMEDIATE" if write else "BEGIN")

    return made


def create_file(file: Path) -> None:
    """An empty database in WAL mode; the mode stays with the file."""
    connection = sqlite3.connect(file)
    connection.execute("PRAGMA journal_mode = WAL")
    connection.close()


def checkpoint(engine: Engine, file: Path) -> None:
    """Fold a grown log into the database. Only under the writer lock: before 3.51.3 a commit meanwhile can corrupt."""
    log = file.with_name(file.name + "-wal")
    if log.exists() and log.stat().st_size > CHECKPOINT_BYTES:
        _raw(engine, "PRAGMA wal_checkpoint(TRUNCATE)")


def integrity_problems(engine: Engine) -> list[str]:
    """What SQLite itself finds wrong with the file."""
    rows = [row[0] for row in _raw(engine, "PRAGMA integrity_check")]
    out = [] if rows == ["ok"] else [str(r) for r in rows]
    return out + [f"row {r[1]} of {r[0]} names a missing {r[2]}" for r in _raw(engine, "PRAGMA foreign_key_check")]


def backup(engine: Engine, target: Path) -> None:
    """A consistent copy of the catalog, whatever else is going on."""
    connection = engine.raw_connection()
    try:
        with sqlite3.connect(target) as copy:
            connection.driver_connection.backup(copy)
        copy.close()
    finally:
        connection.close()


def _raw(engine: Engine, statement: str) -> list[Any]:
    connection = engine.raw_connection()  # a PRAGMA that must run outside any transaction
    try:
        return connection.driver_connection.execute(statement).fetchall()
    finally:
        connection.close()


def _on_read_only_disk(file: Path) -> bool:
    import os

    if os.access(file.parent, os.W_OK):
        return False
    log = file.with_name(file.name + "-wal")
    if log.exists() and log.stat().st_size:
        raise StoreError(
            f"{file.parent} was not closed cleanly and its disk is read-only: open it once where it can be written"
        )
    return True

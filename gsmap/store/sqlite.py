"""What is particular to SQLite: how a connection is opened, how a transaction begins, when the log is folded in."""

from __future__ import annotations

import json
import os
import sqlite3
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Engine, PoolProxiedConnection, create_engine, event

from gsmap.durable import open_file
from gsmap.errors import CorruptError, StoreError
from gsmap.store import held

FILE = "map.sqlite"
DIGEST_FILE = "map.sqlite.sha256"
CHECKPOINT_BYTES = 4 << 20
_JOURNAL_MAGIC = bytes.fromhex("d9d505f920a163d7")  # ends a journal that names a super-journal


def engine(file: Path, *, writable: bool) -> Engine:
    """An engine on one file: WAL, full synchronisation, foreign keys, transactions that we begin ourselves.

    Write transactions (`WRITE` in the execution options) begin IMMEDIATE: a deferred one that turns into a writer
    fails at once when another has written meanwhile, whatever the busy timeout.
    """
    uri = f"{file.resolve().as_uri()}?mode={'rw' if writable else 'ro'}"

    def connect() -> sqlite3.Connection:
        try:
            return _connect(uri)
        except sqlite3.OperationalError:
            if writable or os.access(file.parent, os.W_OK):
                raise
        # A reader in WAL mode must write an index, which it cannot here; then nobody is writing the log either.
        log = file.with_name(file.name + "-wal")
        if log.exists() and log.stat().st_size:
            raise StoreError(f"{file.parent} was not closed cleanly: open it once where it can be written")
        return _connect(f"{uri}&immutable=1")

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


def refuse_super_journal(file: Path) -> None:
    """Refuse a rollback journal that names a super-journal: SQLite would delete the file that it names.

    gsmap's databases are in WAL mode and never attached to one another, so it is not of its making.
    """
    journal = file.with_name(f"{file.name}-journal")
    try:
        with open(open_file(journal), "rb") as opened:
            opened.seek(-min(len(_JOURNAL_MAGIC), journal.stat().st_size), os.SEEK_END)
            ends = opened.read()
    except FileNotFoundError:
        return
    if ends == _JOURNAL_MAGIC:
        raise CorruptError(f"{journal} names another file for SQLite to delete: gsmap writes no such thing; remove it")


def checkpoint(engine: Engine, file: Path, *, at_bytes: int) -> None:
    """Fold a log of at least this size into the database, and note the digest of the result.

    Only under the writer lock: in SQLite before 3.51.3 a commit at the same time can corrupt the file.
    """
    log = file.with_name(file.name + "-wal")
    if log.exists() and log.stat().st_size >= at_bytes:
        _raw(engine, "PRAGMA wal_checkpoint(TRUNCATE)")
        _note_digest(file)


def integrity_problems(engine: Engine) -> list[str]:
    """What SQLite itself finds wrong with its structure; it does not notice other bytes than those written."""
    rows = [row[0] for row in _raw(engine, "PRAGMA integrity_check")]
    out = [] if rows == ["ok"] else [str(r) for r in rows]
    return out + [f"row {r[1]} of {r[0]} names a missing {r[2]}" for r in _raw(engine, "PRAGMA foreign_key_check")]


def damage(file: Path) -> list[str]:
    """What SQLite finds wrong with a file when it looks at all of its structure; empty also where it cannot look."""
    if not file.is_file():
        return [f"{file} is missing"]
    try:
        connection = sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro", uri=True)
        try:
            rows = [str(row[0]) for row in connection.execute("PRAGMA quick_check(10)")]
        finally:
            connection.close()
    except sqlite3.Error as error:
        corrupt = getattr(error, "sqlite_errorcode", 0) & 0xFF in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
        return [str(error)] if corrupt else []
    return [] if rows == ["ok"] else rows


def digest_problems(file: Path) -> list[str]:
    """Whether the file still has the bytes of the last `checkpoint`; nothing is known of one touched since then.

    SQLite keeps no checksums, so a flipped bit in a name or a pose would go unnoticed. A disk that goes bad leaves the
    time of the last change as it was; whatever wrote to the file since did not.
    """
    try:
        noted = json.loads(file.with_name(DIGEST_FILE).read_text())
        if not _same_stamp(file, noted):
            return []
        found = held.sha256(file)
        return (
            []
            if found == noted["sha256"] or not _same_stamp(file, noted)
            else [f"{file} differs from what was written"]
        )
    except FileNotFoundError:
        return []
    except (ValueError, KeyError, TypeError):
        return [f"{file.with_name(DIGEST_FILE)} is damaged"]


def file_problems(file: Path) -> list[str]:
    """As `integrity_problems`, of a file that nobody has open."""
    frozen = create_engine("sqlite://", creator=lambda: _connect(f"{file.resolve().as_uri()}?mode=ro&immutable=1"))
    try:
        return integrity_problems(frozen)
    finally:
        frozen.dispose()


def backup(engine: Engine, target: Path) -> None:
    """A consistent copy of the catalog, whatever else is going on."""
    connection = engine.raw_connection()
    try:
        with sqlite3.connect(target) as copy:
            _driver(connection).backup(copy)
        copy.close()
    finally:
        connection.close()


def _driver(connection: PoolProxiedConnection) -> Any:
    return connection.driver_connection


def _note_digest(file: Path) -> None:
    before = file.stat()
    note = {"sha256": held.sha256(file), "size_bytes": before.st_size, "mtime_ns": before.st_mtime_ns}
    staged = file.with_name(f".{DIGEST_FILE}")
    staged.write_text(json.dumps(note))
    os.replace(staged, file.with_name(DIGEST_FILE))


def _same_stamp(file: Path, noted: dict[str, Any]) -> bool:
    now = file.stat()
    return (now.st_size, now.st_mtime_ns) == (noted["size_bytes"], noted["mtime_ns"])


def _connect(uri: str) -> sqlite3.Connection:
    connection = sqlite3.connect(uri, uri=True, timeout=60.0, isolation_level=None, check_same_thread=False)
    connection.execute("PRAGMA foreign_keys = ON")
    connection.execute("PRAGMA synchronous = FULL")
    connection.execute("PRAGMA wal_autocheckpoint = 0")  # `checkpoint` does it under the writer lock
    connection.execute("PRAGMA trusted_schema = OFF")
    connection.execute("SELECT count(*) FROM sqlite_master").fetchone()  # the file is opened only now
    return connection


def _raw(engine: Engine, statement: str) -> list[Any]:
    connection = engine.raw_connection()  # a PRAGMA that must run outside any transaction
    try:
        return list(_driver(connection).execute(statement).fetchall())
    finally:
        connection.close()

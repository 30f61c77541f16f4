"""Operate SQLite: open connections, start transactions, checkpoint, back up and check integrity."""

from __future__ import annotations

import contextlib
import errno
import os
import sqlite3
import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

from sqlalchemy import Connection, Engine, NullPool, PoolProxiedConnection, QueuePool, create_engine, event

from gsmap.durable import is_file, open_file
from gsmap.errors import CorruptError, StoreError
from gsmap.store import page_digests
from gsmap.store.file_handles import FileHandle
from gsmap.store.wal import read_log, wal_path

FILE = "map.sqlite"
CHECKPOINT_BYTES = 4 << 20
_JOURNAL_MAGIC = bytes.fromhex("d9d505f920a163d7")  # end of a journal that names a super-journal
_READERS_S = 1.0  # wait of a writer for readers before it leaves the rest of the log to the next checkpoint


class _EngineGuard:
    """The resources that must outlive every connection of an engine: a file handle, and a read-only connection.

    When the last connection closes, SQLite checkpoints the log by itself, bypassing the writer lock and the digests. It
    does not while another connection is open, and a read-only connection cannot.
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        self._lock = threading.RLock()  # reentrant: the garbage collector may close a connection at any time
        self._read_connection: sqlite3.Connection | None = None
        self._connections = 0
        self._handle: FileHandle | None = FileHandle(file)

    @property
    def handle(self) -> FileHandle:
        with self._lock:
            if self._handle is None or not self._handle.is_of(self._file):
                self._handle = FileHandle(self._file)
            return self._handle

    def connect(self, uri: str, *, writable: bool) -> sqlite3.Connection:
        with self._lock:
            if writable and self._read_connection is None:
                self._read_connection = _connect(f"{self._file.resolve().as_uri()}?mode=ro")
            made: _GuardedConnection = _connect(uri, _GuardedConnection)
            made.guard = self
            self._connections += 1
            return made

    def leave(self) -> None:
        with self._lock:
            self._connections -= 1

    def release(self) -> bool:
        """Close both resources; return False and keep them if another thread has a connection."""
        with self._lock:
            if self._connections:
                return False
            if self._read_connection is not None:
                self._read_connection.close()
                self._read_connection = None
            if self._handle is not None:
                self._handle.close()
                self._handle = None
            return True

    def __del__(self) -> None:
        self.release()


class _GuardedConnection(sqlite3.Connection):
    """A connection that is closed before its guard is released."""

    guard: _EngineGuard | None = None

    def close(self) -> None:
        super().close()
        guard, self.guard = self.guard, None
        if guard is not None:
            guard.leave()

    def __del__(self) -> None:
        self.close()


_GUARDS: WeakKeyDictionary[Engine, _EngineGuard] = WeakKeyDictionary()


def engine(file: Path, *, writable: bool) -> Engine:
    """Create an engine for one file, with WAL, full synchronization, foreign keys and explicit transactions.

    Write transactions (`gsmap_write` in the execution options) begin IMMEDIATE: a deferred one that becomes a writer
    fails at once if another process has written meanwhile, whatever the busy timeout. Any number of threads may use the
    engine.
    """
    refuse_unexpected_files(file)
    uri = f"{file.resolve().as_uri()}?mode={'rw' if writable else 'ro'}"
    guard = _EngineGuard(file)

    def connect() -> sqlite3.Connection:
        try:
            return guard.connect(uri, writable=writable)
        except sqlite3.OperationalError:
            if writable or os.access(file.parent, os.W_OK):
                raise
            # A reader in WAL mode must write an index, which is impossible here; so no process writes the log either.
            if _log_bytes(file):
                raise StoreError(
                    f"{file.parent} was not closed cleanly: open it once with write access",
                    code="not_closed_cleanly",
                ) from None
            still: sqlite3.Connection = _connect(f"{uri}&immutable=1")
            return still

    made = create_engine("sqlite://", creator=connect, poolclass=QueuePool, max_overflow=-1)
    _GUARDS[made] = guard

    @event.listens_for(made, "begin")
    def begin(connection: Connection) -> None:
        write = connection.get_execution_options().get("gsmap_write", False)
        connection.exec_driver_sql("BEGIN IMMEDIATE" if write else "BEGIN")

    return made


def frozen_engine(file: Path) -> Engine:
    """Create an engine that reads a database and its log without creating the index that SQLite needs for the log.

    For a disk without space for that index; only while no process writes or checkpoints. A log with content is applied
    in memory.
    """

    def connect() -> sqlite3.Connection:
        log = read_log(wal_path(file))
        if not log.frames:
            made: sqlite3.Connection = _connect(f"{file.resolve().as_uri()}?mode=ro&immutable=1")
            return made
        with contextlib.closing(FileHandle(file)) as handle, open(wal_path(file), "rb") as frames:
            content = bytearray(os.pread(handle.number, os.fstat(handle.number).st_size, 0))
            size = page_digests.page_size(handle)
            content = content[: log.num_pages * size].ljust(log.num_pages * size, b"\0")
            for number, at in log.frames.items():
                frames.seek(at)
                content[(number - 1) * size : number * size] = frames.read(size)
        content[18:20] = b"\1\1"  # leave WAL mode, which needs a file
        made = sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False)
        made.deserialize(content)
        made.execute("PRAGMA query_only = ON")
        return made

    return create_engine("sqlite://", creator=connect, poolclass=NullPool)


def needs_room(error: BaseException) -> bool:
    """Return True if SQLite could not connect because it needs to write and cannot."""
    found: object = getattr(error, "orig", None) or error
    code = getattr(found, "sqlite_errorcode", 0) & 0xFF
    return code in (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_READONLY)


def handle(engine: Engine) -> FileHandle:
    """Return the read handle of an engine's file; see `gsmap.store.file_handles`."""
    return _GUARDS[engine].handle


def dispose(engine: Engine, file: Path, *, tidy: bool) -> None:
    """Close all connections without a checkpoint.

    Args:
        tidy: remove the log files if the log is empty and no other process is connected; requires the writer lock.
    """
    engine.dispose()
    if _GUARDS[engine].release() and tidy and wal_path(file).exists() and not _log_bytes(file):
        with contextlib.suppress(sqlite3.Error):
            _connect(f"{file.resolve().as_uri()}?mode=rw").close()  # the last connection removes the log files


def create_file(file: Path) -> None:
    """Create an empty database in WAL mode, a mode that the file keeps.

    Raises:
        OSError: the disk failed, so that SQLite silently kept another journal mode.
    """
    connection = sqlite3.connect(file)
    connection.execute("PRAGMA journal_mode = WAL")
    connection.close()
    if not has_log(file):
        raise OSError(errno.EIO, "SQLite could not set its journal mode", str(file))
    page_digests.write_digests(file)


def has_log(file: Path) -> bool:
    """Return True if a database is in WAL mode, so that writes go only to its log until a checkpoint."""
    with contextlib.closing(FileHandle(file)) as opened:
        return os.pread(opened.number, 2, 18) == b"\2\2"  # file format write and read version


def refuse_unexpected_files(file: Path) -> None:
    """Raise an error for a database that makes SQLite access other files, by a link or a journal with a super-journal.

    gsmap's databases are in WAL mode and never attached to one another, so it never makes such a journal.
    """
    for ending in ("", "-wal", "-shm", "-journal"):
        path = file.with_name(file.name + ending)
        if os.path.lexists(path) and not is_file(path):
            raise CorruptError(
                f"{path} is a link, a pipe or a device, and gsmap creates none: put a file in its place",
                code="link_refused",
            )
    journal = file.with_name(f"{file.name}-journal")
    try:
        with open(open_file(journal), "rb") as opened:
            opened.seek(-min(len(_JOURNAL_MAGIC), journal.stat().st_size), os.SEEK_END)
            ends = opened.read()
    except FileNotFoundError:
        return
    if ends == _JOURNAL_MAGIC:
        raise CorruptError(
            f"{journal} names another file for SQLite to delete, which gsmap does not write: remove it",
            code="hostile_journal",
        )


def checkpoint(engine: Engine, file: Path, *, at_bytes: int) -> None:
    """Checkpoint the log to the database if it has at least ``at_bytes``, and update the page digests.

    Requires the writer lock: in SQLite before 3.51.3 a concurrent commit can corrupt the file.

    Raises:
        CorruptError: the file differs from its digests. The log is kept, so that nothing is lost.
    """
    if _log_bytes(file) >= at_bytes:
        if not page_digests.digests_path(file).exists() and (found := structure_damage(file)):
            raise CorruptError(page_digests.damage_message(file, found), code="catalog_damaged")
        page_digests.fold(
            file, handle(engine), lambda: _checkpoint_passive(engine), lambda: _checkpoint_truncate(engine)
        )


def num_free_bytes(engine: Engine) -> int:
    """Return the size of unused pages of the database in bytes."""
    with engine.connect() as connection:
        pages, size = (
            connection.exec_driver_sql(f"PRAGMA {name}").scalar() for name in ("freelist_count", "page_size")
        )
    return int(pages or 0) * int(size or 0)


def vacuum(engine: Engine, file: Path, *, erase: bool = False) -> bool:
    """Rewrite the database without free pages, and checkpoint the log; the caller must hold the writer lock.

    Args:
        erase: also overwrite freed content.

    Returns:
        True if the log is empty afterwards; False if a reader holds an older state.
    """
    raw = engine.raw_connection()
    try:
        if erase:
            _driver(raw).execute("PRAGMA secure_delete = ON")
        _driver(raw).execute("VACUUM")
    finally:
        raw.close()
    checkpoint(engine, file, at_bytes=1)
    return not _log_bytes(file)


def accept(engine: Engine, file: Path) -> None:
    """Accept the current pages by writing new digests; the caller must hold the writer lock."""
    if not has_log(file):  # changed by another program
        connection = engine.raw_connection()
        try:
            _driver(connection).execute("PRAGMA journal_mode = WAL")
        finally:
            connection.close()
    if _log_bytes(file):
        page_digests.fold(
            file, handle(engine), lambda: _checkpoint_passive(engine), lambda: _checkpoint_truncate(engine), accept=True
        )
    else:
        page_digests.accept(file, handle(engine))


def integrity_problems(connection: Connection) -> list[str]:
    """Return structural problems found by SQLite, which does not detect changed values."""
    return _problems(connection.exec_driver_sql)


def file_problems(file: Path) -> list[str]:
    """Return structural problems of a file that no process has open, without creating files."""
    try:
        with contextlib.closing(_connect(f"{file.resolve().as_uri()}?mode=ro&immutable=1")) as connection:
            return _problems(connection.execute)
    except sqlite3.DatabaseError as error:
        return [str(error)]


def _problems(execute: Callable[[str], Iterable[Any]]) -> list[str]:
    rows = [str(row[0]) for row in execute("PRAGMA integrity_check")]
    missing = [f"row {r[1]} of {r[0]} refers to a missing {r[2]}" for r in execute("PRAGMA foreign_key_check")]
    return ([] if rows == ["ok"] else rows) + missing


def damage(file: Path) -> list[str]:
    """Return problems that the page digests or, without digests, SQLite's quick check find; empty for a sound file."""
    with contextlib.suppress(OSError), contextlib.closing(FileHandle(file)) as opened:
        try:
            found = page_digests.problems(file, opened, page_digests.load(file), read_log(wal_path(file)))
        except CorruptError as error:
            found = [str(error)]
        if found:
            return found
    return structure_damage(file)


def structure_damage(file: Path) -> list[str]:
    """Return problems that SQLite's quick check of the structure finds; empty also if the check cannot run."""
    if not file.is_file():
        return [f"{file} is missing"]
    try:
        with contextlib.closing(_connect(f"{file.resolve().as_uri()}?mode=ro")) as connection:
            rows = [str(row[0]) for row in connection.execute("PRAGMA quick_check(10)")]
    except sqlite3.Error as error:
        corrupt = getattr(error, "sqlite_errorcode", 0) & 0xFF in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
        return [str(error)] if corrupt else []
    return [] if rows == ["ok"] else rows


def backup(connection: Connection, target: Path) -> None:
    """Write a consistent copy of the catalog with digests of its own, also while others access the catalog.

    Args:
        connection: to the catalog; may be one of `frozen_engine`.
    """
    with contextlib.closing(sqlite3.connect(target)) as copy:
        _driver(connection.connection).backup(copy)
    if not has_log(target):  # a frozen copy has left WAL mode
        with contextlib.closing(sqlite3.connect(target)) as copy:
            copy.execute("PRAGMA journal_mode = WAL")
    page_digests.write_digests(target)


def is_read_error(error: BaseException) -> bool:
    """Return True if SQLite failed to read a file, and not to write one."""
    code = getattr(error, "sqlite_errorcode", 0)
    return code & 0xFF in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_BUSY) or code in (
        sqlite3.SQLITE_IOERR_READ,
        sqlite3.SQLITE_IOERR_SHORT_READ,
        sqlite3.SQLITE_IOERR_CORRUPTFS,
        sqlite3.SQLITE_IOERR_SHMSIZE,
        sqlite3.SQLITE_IOERR_SHMOPEN,
        sqlite3.SQLITE_IOERR_SHMMAP,
    )


def _checkpoint_passive(engine: Engine) -> int:
    """Run a passive checkpoint, which waits for no reader; return the number of committed frames in the log."""
    connection = engine.raw_connection()
    try:
        return int(_driver(connection).execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()[1])
    finally:
        connection.close()


def _checkpoint_truncate(engine: Engine) -> bool:
    """Run a truncating checkpoint outside any transaction; return False if readers prevented it."""
    connection = engine.raw_connection()
    try:
        driver = _driver(connection)
        (before,) = driver.execute("PRAGMA busy_timeout").fetchone()
        driver.execute(f"PRAGMA busy_timeout = {round(1000 * _READERS_S)}")
        try:
            busy, _, _ = driver.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
        finally:
            driver.execute(f"PRAGMA busy_timeout = {before}")
        return not busy
    finally:
        connection.close()


def _log_bytes(file: Path) -> int:
    try:
        return wal_path(file).stat().st_size
    except FileNotFoundError:
        return 0


def _driver(connection: PoolProxiedConnection) -> Any:
    return connection.driver_connection


def _connect(uri: str, factory: type[sqlite3.Connection] = sqlite3.Connection) -> Any:
    connection = sqlite3.connect(
        uri, uri=True, timeout=60.0, isolation_level=None, check_same_thread=False, factory=factory
    )
    try:
        connection.execute("PRAGMA foreign_keys = ON")
        connection.execute("PRAGMA synchronous = FULL")
        connection.execute("PRAGMA wal_autocheckpoint = 0")  # `checkpoint` does it under the writer lock
        connection.execute("PRAGMA trusted_schema = OFF")
        connection.execute("SELECT count(*) FROM sqlite_master").fetchone()  # opens the file
    except BaseException:
        connection.close()
        raise
    return connection

"""What is particular to SQLite: how a connection is opened, how a transaction begins, when the log is folded in."""

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
from gsmap.store import digests
from gsmap.store.handles import Handle
from gsmap.store.wal import log_of, read_log

FILE = "map.sqlite"
CHECKPOINT_BYTES = 4 << 20
_JOURNAL_MAGIC = bytes.fromhex("d9d505f920a163d7")  # ends a journal that names a super-journal
_READERS_S = 1.0  # how long a writer waits for readers before it leaves the rest of the log for the next one


class _Anchor:
    """What must outlive every connection of an engine: a handle on the file, and a connection that only reads.

    SQLite folds the log in by itself when the last connection closes, past the writer lock and the digests. It does not
    as long as another one is open, and one that only reads cannot.
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        self._lock = threading.RLock()  # a collected connection may leave at any moment
        self._guard: sqlite3.Connection | None = None
        self._connections = 0
        self._handle: Handle | None = Handle(file)

    @property
    def handle(self) -> Handle:
        with self._lock:
            if self._handle is None or not self._handle.is_of(self._file):
                self._handle = Handle(self._file)
            return self._handle

    def connect(self, uri: str, *, writable: bool) -> sqlite3.Connection:
        with self._lock:
            if writable and self._guard is None:
                self._guard = _connect(f"{self._file.resolve().as_uri()}?mode=ro")
            made: _Anchored = _connect(uri, _Anchored)
            made.anchor = self
            self._connections += 1
            return made

    def leave(self) -> None:
        with self._lock:
            self._connections -= 1

    def lift(self) -> bool:
        """Let go; False as long as another thread has a connection, which then keeps all of this alive."""
        with self._lock:
            if self._connections:
                return False
            if self._guard is not None:
                self._guard.close()
                self._guard = None
            if self._handle is not None:
                self._handle.close()
                self._handle = None
            return True

    def __del__(self) -> None:
        self.lift()


class _Anchored(sqlite3.Connection):
    """A connection that is closed before its anchor is lifted."""

    anchor: _Anchor | None = None

    def close(self) -> None:
        super().close()
        anchor, self.anchor = self.anchor, None
        if anchor is not None:
            anchor.leave()

    def __del__(self) -> None:
        self.close()


_ANCHORS: WeakKeyDictionary[Engine, _Anchor] = WeakKeyDictionary()


def engine(file: Path, *, writable: bool) -> Engine:
    """An engine on one file: WAL, full synchronisation, foreign keys, transactions that we begin ourselves.

    Write transactions (`WRITE` in the execution options) begin IMMEDIATE: a deferred one that turns into a writer
    fails at once when another has written meanwhile, whatever the busy timeout. As many threads may use it as like.
    """
    refuse_strange_files(file)
    uri = f"{file.resolve().as_uri()}?mode={'rw' if writable else 'ro'}"
    anchor = _Anchor(file)

    def connect() -> sqlite3.Connection:
        try:
            return anchor.connect(uri, writable=writable)
        except sqlite3.OperationalError:
            if writable or os.access(file.parent, os.W_OK):
                raise
            # A reader in WAL mode must write an index, which it cannot here; then nobody is writing the log either.
            if _log_bytes(file):
                raise StoreError(
                    f"{file.parent} was not closed cleanly: open it once where it can be written",
                    code="not_closed_cleanly",
                ) from None
            still: sqlite3.Connection = _connect(f"{uri}&immutable=1")
            return still

    made = create_engine("sqlite://", creator=connect, poolclass=QueuePool, max_overflow=-1)
    _ANCHORS[made] = anchor

    @event.listens_for(made, "begin")
    def begin(connection: Connection) -> None:
        write = connection.get_execution_options().get("gsmap_write", False)
        connection.exec_driver_sql("BEGIN IMMEDIATE" if write else "BEGIN")

    return made


def still_engine(file: Path) -> Engine:
    """An engine that reads a database as it lies there, log included, without the index that SQLite makes for the log.

    For a disk without room for that index; only while nobody writes or folds. A log with something in it is folded in
    within memory.
    """

    def connect() -> sqlite3.Connection:
        log = read_log(log_of(file))
        if not log.frames:
            made: sqlite3.Connection = _connect(f"{file.resolve().as_uri()}?mode=ro&immutable=1")
            return made
        with contextlib.closing(Handle(file)) as handle, open(log_of(file), "rb") as frames:
            content = bytearray(os.pread(handle.number, os.fstat(handle.number).st_size, 0))
            size = digests.page_size(handle)
            content = content[: log.num_pages * size].ljust(log.num_pages * size, b"\0")
            for number, at in log.frames.items():
                frames.seek(at)
                content[(number - 1) * size : number * size] = frames.read(size)
        content[18:20] = b"\1\1"  # no WAL mode, which needs a file
        made = sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False)
        made.deserialize(content)
        made.execute("PRAGMA query_only = ON")
        return made

    return create_engine("sqlite://", creator=connect, poolclass=NullPool)


def needs_room(error: BaseException) -> bool:
    """Whether SQLite could not connect for something that it wanted to write."""
    found: object = getattr(error, "orig", None) or error
    code = getattr(found, "sqlite_errorcode", 0) & 0xFF
    return code in (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_READONLY)


def handle(engine: Engine) -> Handle:
    """The handle to read an engine's file with; see `gsmap.store.handles`."""
    return _ANCHORS[engine].handle


def dispose(engine: Engine, file: Path, *, tidy: bool) -> None:
    """Close all connections without folding the log in.

    Args:
        tidy: leave one file at rest, if the log is empty and nobody else is connected; only under the writer lock.
    """
    engine.dispose()
    if _ANCHORS[engine].lift() and tidy and log_of(file).exists() and not _log_bytes(file):
        with contextlib.suppress(sqlite3.Error):
            _connect(f"{file.resolve().as_uri()}?mode=rw").close()  # as the last one it removes the log's files


def create_file(file: Path) -> None:
    """An empty database in WAL mode; the mode stays with the file.

    Raises:
        OSError: the disk failed, so that SQLite left the mode as it was and said nothing of it.
    """
    connection = sqlite3.connect(file)
    connection.execute("PRAGMA journal_mode = WAL")
    connection.close()
    if not has_log(file):
        raise OSError(errno.EIO, "SQLite could not set its journal mode", str(file))
    digests.note(file)


def has_log(file: Path) -> bool:
    """Whether a database is in WAL mode: what is written goes to its log, and nowhere else until that is folded in."""
    with contextlib.closing(Handle(file)) as opened:
        return os.pread(opened.number, 2, 18) == b"\2\2"  # file format write and read version


def refuse_strange_files(file: Path) -> None:
    """Refuse a database that SQLite would come to other files by: a link in the place of one of its own files, or a
    rollback journal that names a super-journal, which SQLite would delete.

    gsmap's databases are in WAL mode and never attached to one another, so such a journal is not of its making.
    """
    for ending in ("", "-wal", "-shm", "-journal"):
        path = file.with_name(file.name + ending)
        if os.path.lexists(path) and not is_file(path):
            raise CorruptError(
                f"{path} is a link, a pipe or a device: gsmap makes none; put a file in its place", code="link_refused"
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
            f"{journal} names another file for SQLite to delete: gsmap writes no such thing; remove it",
            code="hostile_journal",
        )


def checkpoint(engine: Engine, file: Path, *, at_bytes: int) -> None:
    """Fold a log of at least this size into the database, and keep the digests of its pages.

    Only under the writer lock: in SQLite before 3.51.3 a commit at the same time can corrupt the file.

    Raises:
        CorruptError: the file is not what was written. The log stays as it is, so that nothing is lost.
    """
    if _log_bytes(file) >= at_bytes:
        if not digests.digests_of(file).exists() and (found := structure_damage(file)):
            raise CorruptError(digests.damaged(file, found), code="catalog_damaged")
        digests.fold(file, handle(engine), lambda: _begun(engine), lambda: _folded(engine))


def num_free_bytes(engine: Engine) -> int:
    """Of pages of the database that hold nothing."""
    with engine.connect() as connection:
        pages, size = (
            connection.exec_driver_sql(f"PRAGMA {name}").scalar() for name in ("freelist_count", "page_size")
        )
    return int(pages or 0) * int(size or 0)


def vacuum(engine: Engine, file: Path, *, erase: bool = False) -> bool:
    """Write the database anew without what deleted rows left, and fold the log in; only under the writer lock.

    Args:
        erase: overwrite what is left over, too.

    Returns:
        Whether the log is empty then; not where a reader holds an older state.
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
    """Take the pages that there are for what was written, whatever they are; only under the writer lock."""
    if not has_log(file):  # another program changed it
        connection = engine.raw_connection()
        try:
            _driver(connection).execute("PRAGMA journal_mode = WAL")
        finally:
            connection.close()
    if _log_bytes(file):
        digests.fold(file, handle(engine), lambda: _begun(engine), lambda: _folded(engine), accept=True)
    else:
        digests.accept(file, handle(engine))


def integrity_problems(connection: Connection) -> list[str]:
    """What SQLite itself finds wrong with its structure; it does not notice other bytes than those written."""
    return _problems(connection.exec_driver_sql)


def file_problems(file: Path) -> list[str]:
    """As `integrity_problems`, of a file that nobody has open; nothing is made beside it."""
    try:
        with contextlib.closing(_connect(f"{file.resolve().as_uri()}?mode=ro&immutable=1")) as connection:
            return _problems(connection.execute)
    except sqlite3.DatabaseError as error:
        return [str(error)]


def _problems(execute: Callable[[str], Iterable[Any]]) -> list[str]:
    rows = [str(row[0]) for row in execute("PRAGMA integrity_check")]
    missing = [f"row {r[1]} of {r[0]} names a missing {r[2]}" for r in execute("PRAGMA foreign_key_check")]
    return ([] if rows == ["ok"] else rows) + missing


def damage(file: Path) -> list[str]:
    """What is wrong with a file, by the digests of its pages or else by SQLite's own look; empty for a sound one."""
    with contextlib.suppress(OSError), contextlib.closing(Handle(file)) as opened:
        try:
            found = digests.problems(file, opened, digests.load(file), read_log(log_of(file)))
        except CorruptError as error:
            found = [str(error)]
        if found:
            return found
    return structure_damage(file)


def structure_damage(file: Path) -> list[str]:
    """What SQLite finds wrong with a file when it looks at all of its structure; empty also where it cannot look."""
    if not file.is_file():
        return [f"{file} is missing"]
    try:
        with contextlib.closing(_connect(f"{file.resolve().as_uri()}?mode=ro")) as connection:
            rows = [str(row[0]) for row in connection.execute("PRAGMA quick_check(10)")]
    except sqlite3.Error as error:
        corrupt = getattr(error, "sqlite_errorcode", 0) & 0xFF in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
        return [str(error)] if corrupt else []
    return [] if rows == ["ok"] else rows


def backup(engine: Engine, target: Path) -> None:
    """A consistent copy of the catalog with digests of its own, whatever else is going on."""
    connection = engine.raw_connection()
    try:
        with contextlib.closing(sqlite3.connect(target)) as copy:
            _driver(connection).backup(copy)
    finally:
        connection.close()
    digests.note(target)


def _begun(engine: Engine) -> int:
    """Let SQLite fold in what no reader needs, without waiting; how many frames of the log are committed to it."""
    connection = engine.raw_connection()
    try:
        return int(_driver(connection).execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()[1])
    finally:
        connection.close()


def _folded(engine: Engine) -> bool:
    """Let SQLite fold the log in, outside any transaction; whether it got to the end in spite of readers."""
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
        return log_of(file).stat().st_size
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
        connection.execute("SELECT count(*) FROM sqlite_master").fetchone()  # the file is opened only now
    except BaseException:
        connection.close()
        raise
    return connection

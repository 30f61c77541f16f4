"""Transactions of the catalog, with one writer at a time and readable errors."""

from __future__ import annotations

import contextlib
import logging
import os
import sqlite3
import threading
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from sqlalchemy import Column, ColumnElement, Connection, Engine, RootTransaction, create_engine, func, select
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError, NoSuchModuleError, SQLAlchemyError

from gsmap.durable import lock_within
from gsmap.errors import BusyError, ConfigError, CorruptError, MissingDependencyError, StoreError
from gsmap.store import advisory_locks, page_digests, sqlite, trust
from gsmap.store.error_translation import NOT_KEPT, display_name, is_full, summary, translate_errors
from gsmap.store.wal import read_log, wal_path

LOCK_FILE = "lock"
_MAX_COMPARISONS = 3  # attempts before writers are paused
_log = logging.getLogger("gsmap.store")


class Catalog:
    """A database with the tables of `gsmap.store.schema`, and the map's writer lock.

    Args:
        folder: folder of the map or branch.
        engine: engine of its database.
        writable: allow `write`.
        patience_s: seconds that a writer waits for other writers before `BusyError`.
        read_only_message: message for attempts to write to a read-only catalog; default: that it was opened for
            reading.
    """

    def __init__(
        self, folder: Path, engine: Engine, *, writable: bool, patience_s: float = 120.0, read_only_message: str = ""
    ) -> None:
        self.folder = folder
        self._read_only_message = (
            read_only_message
            or f"{display_name(folder)} is open for reading only (read-only disk, missing permission, or mode 'r')"
        )
        self._engine: Engine | None = engine
        self.writable = writable
        self.patience_s = patience_s
        self._thread = threading.local()
        self._folder_id = _id_of(folder)

    @property
    def engine(self) -> Engine:
        """The engine of its database, by which everything is read and written.

        Raises:
            StoreError: the catalog was closed.
        """
        if self._engine is None:
            raise StoreError(f"{display_name(self.folder)} was closed: open it again", code="map_closed")
        return self._engine

    @property
    def is_sqlite(self) -> bool:
        return self.engine.dialect.name == "sqlite"

    def signature(self) -> str | None:
        """Return a text that changes whenever the catalog may have been written; None for a catalog on a server."""
        if not self.is_sqlite:
            return None
        parts = []
        for name in (sqlite.FILE, f"{sqlite.FILE}-wal"):
            with contextlib.suppress(FileNotFoundError):
                about = (self.folder / name).stat()
                parts.append(f"{name} {about.st_ino} {about.st_size} {about.st_mtime_ns}")
        return " ".join(parts)

    @property
    def _has_lock(self) -> int:
        """Return 1 while this thread holds the writer lock, otherwise 0."""
        return int(getattr(self._thread, "depth", 0))

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        self._thread.depth = 1
        try:
            yield
        finally:
            self._thread.depth = 0

    @property
    def _busy_message(self) -> str:
        return f"{display_name(self.folder)}: other processes have been writing"

    @property
    def _writing(self) -> Connection | None:
        return getattr(self._thread, "connection", None)

    @contextlib.contextmanager
    def read(self, *, newest: bool = False) -> Iterator[Connection]:
        """Open a snapshot read: a transaction that sees one state of the map, whatever other processes write.

        Inside another transaction of the same thread it joins that one.

        Args:
            newest: see the newest state even inside an older snapshot.
        """
        snapshot = getattr(self._thread, "reading", None)
        within = self._writing or (None if newest else snapshot)
        if within is not None:
            yield within
            return
        with translate_errors(self.folder), self._reading() as connection, connection.begin():
            self._thread.reading = connection
            try:
                yield connection
            finally:
                self._thread.reading = snapshot

    @contextlib.contextmanager
    def _reading(self) -> Iterator[Connection]:
        """Open a connection for reading; on a full disk, open a frozen state, which needs no space."""
        try:
            connection = self.engine.connect()
        except (SQLAlchemyError, sqlite3.Error) as error:
            if not self.is_sqlite or not sqlite.needs_room(error) or not is_full(self.folder):
                raise
            with self.pause_writers():
                engine = sqlite.frozen_engine(self.folder / sqlite.FILE)
                with engine.connect() as frozen:
                    yield frozen
            return
        with connection:
            if not self.is_sqlite:  # otherwise each statement would see the newest state
                connection = connection.execution_options(isolation_level="REPEATABLE READ")
            yield connection

    def copy(self, target: Path) -> None:
        """Write a consistent copy of an SQLite catalog, with its own page digests, to a new file.

        Works on a full disk; errors name the disk that failed: that of the catalog or of the copy.
        """
        with translate_errors(self.folder), self._reading() as connection:
            try:
                sqlite.backup(connection, target)
            except (sqlite3.Error, OSError) as error:
                with translate_errors(self.folder if sqlite.is_read_error(error) else target.parent):
                    raise

    @contextlib.contextmanager
    def write(self) -> Iterator[Connection]:
        """Open a transaction that commits durably at the end of the block, or changes nothing if the block raises.

        Inside another transaction of the same thread it joins that one.
        """
        if self._writing is not None:
            yield self._writing
            return
        if not self.writable:
            raise StoreError(self._read_only_message, code="not_writable")
        with self.lock() if self.is_sqlite else contextlib.nullcontext():
            with translate_errors(self.folder, NOT_KEPT), self.engine.connect() as connection:
                try:
                    with (
                        contextlib.ExitStack() as until_end,
                        connection.execution_options(gsmap_write=True).begin() as transaction,
                    ):
                        if not self._has_lock:  # on a server the lock belongs to the transaction
                            advisory_locks.acquire(
                                connection, advisory_locks.WRITER, self.patience_s, self._busy_message
                            )
                            until_end.enter_context(self._locked())
                        self._thread.connection, self._thread.until_end = connection, until_end
                        yield connection
                        with translate_errors(self.folder, NOT_KEPT, committing=True):
                            commit(connection, transaction)
                finally:
                    self._thread.connection = None
            self._fold(at_bytes=sqlite.CHECKPOINT_BYTES)

    def hold_until_commit(self, context: contextlib.AbstractContextManager[Any]) -> None:
        """Hold a lock from now until the surrounding `write` transaction is committed or rolled back."""
        self._thread.until_end.enter_context(context)

    @contextlib.contextmanager
    def lock(self, patience_s: float | None = None) -> Iterator[None]:
        """Hold the map's writer lock; reentrant within a thread. The kernel frees it when a process dies.

        Raises:
            StoreError: the map was opened for reading, or its folder was moved or replaced since.
            BusyError: another process kept the lock for ``patience_s``.
        """
        if not self.writable:
            raise StoreError(self._read_only_message, code="not_writable")
        if self._has_lock:
            yield
            return
        patience_s = self.patience_s if patience_s is None else patience_s
        if not self.is_sqlite:
            with self._server_lock(advisory_locks.WRITER, patience_s), self._locked():
                yield
            return
        if _id_of(self.folder) != self._folder_id:
            # SQLite would write to the catalog where it is now, and arrays would go to the old path.
            raise StoreError(
                f"{display_name(self.folder)} was moved, replaced or deleted while it was open: open it again",
                code="changed_meanwhile",
            )
        try:
            handle = os.open(self.folder / LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o666)
        except OSError as error:
            with translate_errors(self.folder, NOT_KEPT):
                raise error
        try:
            lock_within(handle, patience_s, self._busy_message)
            with self._locked():
                yield
        finally:
            os.close(handle)

    @contextlib.contextmanager
    def arrays_lock(self, patience_s: float = 120.0) -> Iterator[None]:
        """Hold the lock of `gsmap.store.arrays.Arrays.lock` for arrays in an object store, on the catalog's server."""
        with self._server_lock(advisory_locks.ARRAYS, patience_s):
            yield

    @contextlib.contextmanager
    def _server_lock(self, lock: int, patience_s: float, *, shared: bool = False) -> Iterator[None]:
        """Hold a lock of the server in a separate transaction, which ends with this process."""
        with translate_errors(self.folder, NOT_KEPT), self.engine.connect() as connection, connection.begin():
            advisory_locks.acquire(connection, lock, patience_s, self._busy_message, shared=shared)
            yield

    @contextlib.contextmanager
    def pause_writers(self) -> Iterator[None]:
        """Keep all processes from writing for a moment; needs no permission to write.

        Must not be started while holding the lock of the arrays: a writer that holds the writer lock may wait for that
        lock.
        """
        if self._has_lock:
            yield
        elif self.is_sqlite:
            with pause_writers(self.folder, self.patience_s):
                yield
        else:
            with self._server_lock(advisory_locks.WRITER, self.patience_s, shared=True):
                yield

    def verify(self, *, whole: bool = False) -> None:
        """Compare the catalog's pages with their digests; only `check` does so for a large catalog.

        Args:
            whole: compare all pages, however many there are.

        Raises:
            CorruptError: pages differ, or the file is not in WAL mode, so that writes would bypass the digests.
        """
        if self.is_sqlite:
            file = self.folder / sqlite.FILE
            if self.writable and not sqlite.has_log(file):
                raise CorruptError(
                    page_digests.damage_message(file, ["another program changed its journal mode"]),
                    code="catalog_damaged",
                )
            found = self.page_problems(at_most_bytes=None if whole else page_digests.WHOLE_BYTES)
            if found:
                backup = page_digests.find_backup_digests(file, sqlite.handle(self.engine))
                if backup is None or read_log(wal_path(file)).frames:
                    raise CorruptError(page_digests.damage_message(file, found), code="catalog_damaged")
                if self.writable:  # the backup was restored by hand
                    with self.lock():
                        page_digests.save(file, backup)

    def page_problems(self, *, at_most_bytes: int | None = None) -> list[str]:
        """Return a message for each difference between the catalog's file or log and the page digests.

        Args:
            at_most_bytes: check only the log of a longer file.
        """
        file = self.folder / sqlite.FILE
        with translate_errors(self.folder):
            for _ in range(_MAX_COMPARISONS):
                found = self._compare_pages(file, at_most_bytes)
                if not found:
                    return []
            with self.pause_writers():  # either concurrent writes or damage
                return self._compare_pages(file, at_most_bytes)

    def _compare_pages(self, file: Path, at_most_bytes: int | None) -> list[str]:
        handle = sqlite.handle(self.engine)
        try:
            stored = page_digests.load(file)
        except CorruptError as error:
            return [str(error)]
        log = read_log(wal_path(file), handle.index)
        if at_most_bytes is not None and (size := os.fstat(handle.number).st_size) > at_most_bytes:
            _log.info("%s has %.0f MB: only gsmap check compares its pages with their digests", file, size / 1e6)
            return [f"in its log {log.problem}"] if log.problem else []
        return page_digests.problems(file, handle, stored, log)

    def unverified(self) -> list[str]:
        """Return the reasons why the catalog's bytes cannot be verified; empty if they can be verified."""
        if self.is_sqlite:
            if page_digests.digests_path(self.folder / sqlite.FILE).exists():
                return []
            return ["the catalog was written by an older gsmap without page digests: the next write adds them"]
        if self.engine.dialect.name != "postgresql":
            return ["the catalog lies in a database whose integrity gsmap cannot verify"]
        with self.read() as connection:
            checks = connection.exec_driver_sql("SHOW data_checksums").scalar() == "on"
        says = (
            "on, so that it verifies each page that it reads" if checks else "off, so that damaged pages go unnoticed"
        )
        return [f"the catalog lies in a PostgreSQL server, whose own page checksums are {says}"]

    def accept(self) -> list[str]:
        """Accept the catalog's pages as they are, write new digests, and return the differences found.

        Raises:
            CorruptError: SQLite finds the file damaged.
        """
        if not self.is_sqlite:
            raise ConfigError(
                f"{self.folder}: its catalog is not a file of the map: only an SQLite catalog can be accepted",
                code="nothing_to_accept",
            )
        with self.lock(), translate_errors(self.folder):
            found = self.page_problems()
            with self.read() as connection:
                wrong = sqlite.integrity_problems(connection)
            if wrong:
                raise CorruptError(
                    f"{self.folder}: the catalog cannot be accepted, SQLite finds {summary(wrong)}: restore "
                    f"{sqlite.FILE} from a backup",
                    code="catalog_damaged",
                )
            sqlite.accept(self.engine, self.folder / sqlite.FILE)
        return found

    def close(self, *, fold: bool = True) -> None:
        """Close the catalog, leaving a single file unless other processes use it.

        Args:
            fold: checkpoint the log; False if the map turned out to be damaged.
        """
        if self._engine is None:
            return
        file = self.folder / sqlite.FILE
        try:
            if self.is_sqlite and self.writable and fold and _id_of(self.folder) == self._folder_id:
                with contextlib.suppress(BusyError), self.lock(patience_s=0.0):
                    self._fold(at_bytes=1)
                    sqlite.dispose(self.engine, file, tidy=True)
        finally:
            if self.is_sqlite:
                sqlite.dispose(self.engine, file, tidy=False)
            else:
                self.engine.dispose()
            self._engine = None

    def _fold(self, at_bytes: int) -> None:
        """Checkpoint the log, holding the lock. A failure loses nothing, since committed data stays in the log."""
        if not self.is_sqlite:
            return
        try:
            with translate_errors(self.folder):
                sqlite.checkpoint(self.engine, self.folder / sqlite.FILE, at_bytes=at_bytes)
        except CorruptError as error:
            raise CorruptError(f"{error}; later writes are kept in its log", code="catalog_damaged") from error
        except StoreError as error:
            _log.warning("the writes are kept in the log, but not yet checkpointed into %s: %s", sqlite.FILE, error)


@contextlib.contextmanager
def pause_writers(folder: Path, patience_s: float) -> Iterator[None]:
    """Pause the writers of the catalog in a folder; see `Catalog.pause_writers`."""
    try:
        handle = os.open(folder / LOCK_FILE, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
    except OSError:  # no lock file: never written, or not writable
        yield
        return
    try:
        lock_within(handle, patience_s, f"{folder}: other processes have been writing", shared=True)
        yield
    finally:
        os.close(handle)


def commit(connection: Connection, transaction: RootTransaction) -> None:
    """Commit, or invalidate the connection if that fails."""
    try:
        transaction.commit()
    except BaseException:
        connection.invalidate()
        raise


def _id_of(folder: Path) -> tuple[int, int] | None:
    """Return the device and inode of a folder; None if it is missing."""
    try:
        found = os.stat(folder)
    except OSError:
        return None
    return found.st_dev, found.st_ino


def open_engine(folder: Path, *, writable: bool) -> Engine:
    """Open the engine of a map's catalog: ``map.sqlite``, or the database in ``catalog.url`` if the user trusts it."""
    if (folder / sqlite.FILE).is_file():
        return sqlite.engine(folder / sqlite.FILE, writable=writable)
    return url_engine(trust.catalog_url(folder))


def url_engine(url: str) -> Engine:
    """Create the engine for a database URL; does not connect yet."""
    try:
        if make_url(url).get_backend_name() != "postgresql":
            raise ConfigError(
                f"{url_without_password(url)!r} is not a PostgreSQL database URL (postgresql+psycopg://...)",
                code="invalid_catalog_url",
            )
        return create_engine(url, pool_pre_ping=True)
    except (ArgumentError, NoSuchModuleError) as error:
        raise ConfigError(f"{url!r} is not a valid database URL: {error}", code="invalid_catalog_url") from error
    except ModuleNotFoundError as error:
        raise MissingDependencyError(f"the catalog needs the package {error.name}", extra="postgres") from error


def url_without_password(url: str) -> str:
    """Return a database URL without password; the driver reads the password from ``PGPASSWORD`` or ``~/.pgpass``."""
    known = make_url(url).difference_update_query(["password"])._replace(password=None)
    return known.render_as_string(hide_password=False)


def now() -> str:
    """Return the current UTC time in ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="microseconds")


def timestamp_after(moment: datetime) -> str:
    """Return the first time after a moment that `now` may return."""
    return (moment + timedelta(microseconds=1)).astimezone(UTC).isoformat(timespec="microseconds")


def next_timestamp(connection: Connection, created_at: Column[str], *among: ColumnElement[bool]) -> str:
    """Return the current time, or a time just after the newest row if a clock was ahead when that row was written.

    Ordering rows by time then gives the order in which they were written.

    Args:
        created_at: column with the time.
        among: conditions on the rows among which the new one is ordered.
    """
    when, newest = now(), connection.execute(select(func.max(created_at)).where(*among)).scalar()
    if newest is None or newest < when:
        return when
    try:
        return timestamp_after(datetime.fromisoformat(newest))
    except (ValueError, OverflowError, TypeError):  # not written by gsmap
        return when

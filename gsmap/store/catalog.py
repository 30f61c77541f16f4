"""The catalog's transactions: one writer at a time, errors in our words."""

from __future__ import annotations

import contextlib
import fcntl
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
from gsmap.store import advisory, digests, sqlite, trust
from gsmap.store.explained import NOT_KEPT, called, explained, is_full, summary
from gsmap.store.wal import log_of, read_log

LOCK_FILE = "lock"
_LOOKS = 3  # at pages that others are writing, before they are asked to wait
_log = logging.getLogger("gsmap.store")


class Catalog:
    """A database with the tables of `gsmap.store.schema`, and the map's writer lock.

    Args:
        folder: the map.
        engine: on its database.
        writable: whether `write` may be called.
        patience_s: how long a writer waits for the others before `BusyError`.
        refusal: what to tell who would write where that may not be; by default, that it was opened for reading.
    """

    def __init__(
        self, folder: Path, engine: Engine, *, writable: bool, patience_s: float = 120.0, refusal: str = ""
    ) -> None:
        self.folder = folder
        self._refusal = refusal or f"{called(folder)} was opened for reading: open it with mode 'w' to change it"
        self.engine = engine
        self.writable = writable
        self.patience_s = patience_s
        self._held = threading.local()

    @property
    def is_sqlite(self) -> bool:
        return self.engine.dialect.name == "sqlite"

    def signature(self) -> str | None:
        """Another text whenever anything may have been written, by whomever; None where that cannot be told quickly."""
        if not self.is_sqlite:
            return None
        said = []
        for name in (sqlite.FILE, f"{sqlite.FILE}-wal"):
            with contextlib.suppress(FileNotFoundError):
                about = (self.folder / name).stat()
                said.append(f"{name} {about.st_ino} {about.st_size} {about.st_mtime_ns}")
        return " ".join(said)

    @property
    def _depth(self) -> int:
        """Whether this thread holds the writer lock."""
        return int(getattr(self._held, "depth", 0))

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        self._held.depth = 1
        try:
            yield
        finally:
            self._held.depth = 0

    @property
    def _busy(self) -> str:
        return f"{called(self.folder)}: others have been writing"

    @property
    def _writing(self) -> Connection | None:
        return getattr(self._held, "connection", None)

    @contextlib.contextmanager
    def read(self) -> Iterator[Connection]:
        """A transaction that sees one state of the map, whatever others write.

        Inside another one of the same thread, or inside `write`, it is that one.
        """
        within = self._writing or getattr(self._held, "reading", None)
        if within is not None:
            yield within
            return
        with explained(self.folder), self._reading() as connection, connection.begin():
            self._held.reading = connection
            try:
                yield connection
            finally:
                self._held.reading = None

    @contextlib.contextmanager
    def _reading(self) -> Iterator[Connection]:
        """A connection; on a full disk one that needs no room there, for which writers wait meanwhile."""
        try:
            connection = self.engine.connect()
        except (SQLAlchemyError, sqlite3.Error) as error:
            if not self.is_sqlite or not sqlite.needs_room(error) or not is_full(self.folder):
                raise
            with self.still():
                engine = sqlite.still_engine(self.folder / sqlite.FILE)
                with engine.connect() as still:
                    yield still
            return
        with connection:
            if not self.is_sqlite:  # else each statement would see what is newest
                connection = connection.execution_options(isolation_level="REPEATABLE READ")
            yield connection

    @contextlib.contextmanager
    def write(self) -> Iterator[Connection]:
        """A transaction that commits at the end of the block, or leaves nothing; durable once the block is left.

        Inside another one of the same thread it is part of that one.
        """
        if self._writing is not None:
            yield self._writing
            return
        if not self.writable:
            raise StoreError(self._refusal, code="catalog_refused")
        with self.lock() if self.is_sqlite else contextlib.nullcontext():
            with explained(self.folder, NOT_KEPT), self.engine.connect() as connection:
                try:
                    with (
                        contextlib.ExitStack() as until_end,
                        connection.execution_options(gsmap_write=True).begin() as transaction,
                    ):
                        if not self._depth:  # on a server, where the lock is the transaction's own
                            advisory.take(connection, advisory.WRITER, self.patience_s, self._busy)
                            until_end.enter_context(self._locked())
                        self._held.connection, self._held.until_end = connection, until_end
                        yield connection
                        with explained(self.folder, NOT_KEPT, committing=True):
                            commit(connection, transaction)
                finally:
                    self._held.connection = None
            self._fold(at_bytes=sqlite.CHECKPOINT_BYTES)

    def hold(self, context: contextlib.AbstractContextManager[Any]) -> None:
        """Inside `write`: hold a lock from now until the transaction has been committed or undone."""
        self._held.until_end.enter_context(context)

    @contextlib.contextmanager
    def lock(self, patience_s: float | None = None) -> Iterator[None]:
        """Hold the map's writer lock (again in the same thread: nothing). The kernel frees it when a process dies.

        Raises:
            StoreError: the map was opened for reading.
            BusyError: another process kept it for ``patience_s``.
        """
        if not self.writable:
            raise StoreError(self._refusal, code="catalog_refused")
        if self._depth:
            yield
            return
        patience_s = self.patience_s if patience_s is None else patience_s
        if not self.is_sqlite:
            with self._advised(advisory.WRITER, patience_s), self._locked():
                yield
            return
        try:
            handle = os.open(self.folder / LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o666)
        except OSError as error:
            with explained(self.folder, NOT_KEPT):
                raise error
        try:
            lock_within(handle, fcntl.LOCK_EX, patience_s, self._busy)
            with self._locked():
                yield
        finally:
            os.close(handle)

    @contextlib.contextmanager
    def arrays_lock(self, patience_s: float = 120.0) -> Iterator[None]:
        """As `gsmap.store.arrays.Arrays.lock`, of arrays that lie in no folder; the catalog is on a server."""
        with self._advised(advisory.ARRAYS, patience_s):
            yield

    @contextlib.contextmanager
    def _advised(self, lock: int, patience_s: float, *, shared: bool = False) -> Iterator[None]:
        """Hold a lock of the server's by a transaction of its own, which ends with this process."""
        with explained(self.folder, NOT_KEPT), self.engine.connect() as connection, connection.begin():
            advisory.take(connection, lock, patience_s, self._busy, shared=shared)
            yield

    @contextlib.contextmanager
    def still(self) -> Iterator[None]:
        """Keep everybody from writing for a moment, without the right to write.

        Not to be begun by who holds the lock of the arrays: a writer waits for that one while we wait for this one.
        """
        if self._depth:
            yield
        elif self.is_sqlite:
            with still(self.folder, self.patience_s):
                yield
        else:
            with self._advised(advisory.WRITER, self.patience_s, shared=True):
                yield

    def verify(self, *, whole: bool = False) -> None:
        """Compare the catalog's pages with what was written, unless there are very many; `check` does it always.

        Args:
            whole: compare all of them, however many there are.

        Raises:
            CorruptError: they differ, or the file is not in WAL mode: what is written would go past its digests.
        """
        if self.is_sqlite:
            file = self.folder / sqlite.FILE
            if self.writable and not sqlite.has_log(file):
                raise CorruptError(
                    digests.damaged(file, ["another program changed its journal mode"]), code="catalog_damaged"
                )
            found = self.page_problems(at_most_bytes=None if whole else digests.WHOLE_BYTES)
            if found:
                backup = digests.is_backup(file, sqlite.handle(self.engine))
                if backup is None or read_log(log_of(file)).frames:
                    raise CorruptError(digests.damaged(file, found), code="catalog_damaged")
                if self.writable:  # somebody put it back
                    with self.lock():
                        digests.save(file, backup)

    def page_problems(self, *, at_most_bytes: int | None = None) -> list[str]:
        """What in the catalog's file and its log differs from what was written.

        Args:
            at_most_bytes: of a longer file look at the log alone.
        """
        file = self.folder / sqlite.FILE
        with explained(self.folder):
            for _ in range(_LOOKS):
                found = self._look(file, at_most_bytes)
                if not found:
                    return []
            with self.still():  # others were writing while we looked, or it is damage
                return self._look(file, at_most_bytes)

    def _look(self, file: Path, at_most_bytes: int | None) -> list[str]:
        handle = sqlite.handle(self.engine)
        try:
            noted = digests.load(file)
        except CorruptError as error:
            return [str(error)]
        log = read_log(log_of(file), handle.index)
        if at_most_bytes is not None and (size := os.fstat(handle.number).st_size) > at_most_bytes:
            _log.info("%s has %.0f MB: only gsmap check compares its pages with their digests", file, size / 1e6)
            return [f"in its log {log.problem}"] if log.problem else []
        return digests.problems(file, handle, noted, log)

    def unverified(self) -> list[str]:
        """Why the catalog's bytes cannot be compared with what was written; empty where they can."""
        if self.is_sqlite:
            if digests.digests_of(self.folder / sqlite.FILE).exists():
                return []
            return [
                "the catalog was written by an older gsmap, which kept no digests of its pages: the next write does"
            ]
        if self.engine.dialect.name != "postgresql":
            return ["the catalog lies in a database that gsmap knows nothing of"]
        with self.read() as connection:
            checks = connection.exec_driver_sql("SHOW data_checksums").scalar() == "on"
        says = "on, so that it verifies what it reads" if checks else "off, so that nobody verifies it"
        return [f"the catalog lies in a PostgreSQL server, whose own page checksums are {says}"]

    def accept(self) -> list[str]:
        """Take the catalog's pages for what was written, whatever they are; what differed, in words.

        Raises:
            CorruptError: SQLite cannot make sense of them.
        """
        if not self.is_sqlite:
            raise ConfigError(
                f"{self.folder}: its catalog is no file of the map, so that there is nothing to accept",
                code="nothing_to_accept",
            )
        with self.lock(), explained(self.folder):
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
        """Leave one file at rest, unless others are still at it.

        Args:
            fold: whether to touch anything; off where the map turned out to be damaged.
        """
        if not self.is_sqlite:
            self.engine.dispose()
            return
        file = self.folder / sqlite.FILE
        try:
            if self.writable and fold:
                with contextlib.suppress(BusyError), self.lock(patience_s=0.0):
                    self._fold(at_bytes=1)
                    sqlite.dispose(self.engine, file, tidy=True)
        finally:
            sqlite.dispose(self.engine, file, tidy=False)

    def _fold(self, at_bytes: int) -> None:
        """Fold the log in, under the lock. What was committed is in the log, so that a failure costs nothing."""
        if not self.is_sqlite:
            return
        try:
            with explained(self.folder):
                sqlite.checkpoint(self.engine, self.folder / sqlite.FILE, at_bytes=at_bytes)
        except CorruptError as error:
            raise CorruptError(f"{error}; what was written since is kept in its log", code="catalog_damaged") from error
        except StoreError as error:
            _log.warning("what was written is kept, but not yet folded into %s: %s", sqlite.FILE, error)


@contextlib.contextmanager
def still(folder: Path, patience_s: float) -> Iterator[None]:
    """See `Catalog.still`; of the catalog in a folder."""
    try:
        handle = os.open(folder / LOCK_FILE, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
    except OSError:  # then nobody has ever written here, or nobody can
        yield
        return
    try:
        lock_within(handle, fcntl.LOCK_SH, patience_s, f"{folder}: others have been writing")
        yield
    finally:
        os.close(handle)


def commit(connection: Connection, transaction: RootTransaction) -> None:
    """Commit, or leave nothing open: a connection that could not commit is not used again."""
    try:
        transaction.commit()
    except BaseException:
        connection.invalidate()
        raise


def open_engine(folder: Path, *, writable: bool) -> Engine:
    """The engine of a map: its own ``map.sqlite``, or what ``catalog.url`` names if the user trusts that."""
    if (folder / sqlite.FILE).is_file():
        return sqlite.engine(folder / sqlite.FILE, writable=writable)
    return url_engine(trust.named_url(folder))


def url_engine(url: str) -> Engine:
    """The engine of a catalog on a server that the user named or trusts; nothing is connected to yet."""
    try:
        if make_url(url).get_backend_name() != "postgresql":
            raise ConfigError(
                f"{url_without_password(url)!r} is not a PostgreSQL database URL (postgresql+psycopg://...)",
                code="invalid_catalog_url",
            )
        return create_engine(url, pool_pre_ping=True)
    except (ArgumentError, NoSuchModuleError) as error:
        raise ConfigError(
            f"{url!r} is not a database URL that SQLAlchemy knows: {error}", code="invalid_catalog_url"
        ) from error
    except ModuleNotFoundError as error:
        raise MissingDependencyError(f"the catalog needs the package {error.name}: pip install {error.name}") from error


def url_without_password(url: str) -> str:
    """What may lie in a file: the password comes from the driver's own places (``PGPASSWORD``, ``~/.pgpass``)."""
    known = make_url(url).difference_update_query(["password"])._replace(password=None)
    return known.render_as_string(hide_password=False)


def now() -> str:
    """The current time, ISO 8601, UTC."""
    return datetime.now(UTC).isoformat(timespec="microseconds")


def after(moment: datetime) -> str:
    """The first time after a moment that `now` may return."""
    return (moment + timedelta(microseconds=1)).astimezone(UTC).isoformat(timespec="microseconds")


def later(connection: Connection, created_at: Column[str], *among: ColumnElement[bool]) -> str:
    """The current time, or the first after the newest row where that has a later one: the clock was ahead once.

    Rows that are read in order of time are then in the order in which they were written.

    Args:
        created_at: the column with the time.
        among: conditions on the rows that the new one is ordered among.
    """
    when, newest = now(), connection.execute(select(func.max(created_at)).where(*among)).scalar()
    if newest is None or newest < when:
        return when
    try:
        return after(datetime.fromisoformat(newest))
    except (ValueError, OverflowError, TypeError):  # gsmap did not write that
        return when

"""The catalog's transactions: one writer at a time, errors in our words."""

from __future__ import annotations

import contextlib
import fcntl
import os
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Engine, create_engine
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError, DBAPIError, NoSuchModuleError, SQLAlchemyError

from gsmap.errors import BusyError, ConfigError, CorruptError, GsmapError, MissingDependencyError, StoreError
from gsmap.store import sqlite

URL_FILE = "catalog.url"
LOCK_FILE = "lock"


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
        self._refusal = refusal or f"{folder} was opened for reading: open it with mode 'w' to change it"
        self.engine = engine
        self.writable = writable
        self.patience_s = patience_s
        self._held = threading.local()

    @property
    def is_sqlite(self) -> bool:
        return self.engine.dialect.name == "sqlite"

    @property
    def _writing(self) -> Connection | None:
        return getattr(self._held, "connection", None)

    @contextlib.contextmanager
    def read(self) -> Iterator[Connection]:
        """A transaction that sees one state of the map, whatever others write (inside `write`: that transaction)."""
        if self._writing is not None:
            yield self._writing
            return
        with explained(self.folder), self.engine.connect() as connection, connection.begin():
            yield connection

    @contextlib.contextmanager
    def write(self) -> Iterator[Connection]:
        """A transaction that commits at the end of the block, or leaves nothing; durable once the block is left.

        Inside another one of the same thread it is part of that one.
        """
        if self._writing is not None:
            yield self._writing
            return
        with self.lock(), explained(self.folder), self.engine.connect() as connection:
            try:
                with contextlib.ExitStack() as until_end, connection.execution_options(gsmap_write=True).begin():
                    self._held.connection, self._held.until_end = connection, until_end
                    yield connection
            finally:
                self._held.connection = None
            self._checkpoint(at_bytes=sqlite.CHECKPOINT_BYTES)

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
            raise StoreError(self._refusal)
        if getattr(self._held, "depth", 0):
            yield
            return
        try:
            handle = os.open(self.folder / LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        except OSError as error:
            raise StoreError(f"cannot write to {self.folder}: {error.strerror}") from error
        try:
            patience_s = self.patience_s if patience_s is None else patience_s
            deadline = time.monotonic() + patience_s
            while True:
                try:
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                except BlockingIOError:
                    if time.monotonic() > deadline:
                        raise BusyError(
                            f"{self.folder}: others have been writing for {patience_s:g} s; try again later"
                        ) from None
                    time.sleep(0.01)
            self._held.depth = 1
            yield
        finally:
            self._held.depth = 0
            os.close(handle)

    def close(self) -> None:
        """Leave one file at rest, unless others are still at it."""
        if self.writable and self.is_sqlite:
            with contextlib.suppress(GsmapError), explained(self.folder), self.lock(patience_s=0.0):
                self._checkpoint(at_bytes=1)
        self.engine.dispose()

    def _checkpoint(self, at_bytes: int) -> None:
        if self.is_sqlite:
            sqlite.checkpoint(self.engine, self.folder / sqlite.FILE, at_bytes=at_bytes)


def open_engine(folder: Path, *, writable: bool) -> Engine:
    """The engine of a map: its own ``map.sqlite``, or what ``catalog.url`` names."""
    if (folder / sqlite.FILE).is_file():
        return sqlite.engine(folder / sqlite.FILE, writable=writable)
    return url_engine((folder / URL_FILE).read_text().strip())


def url_engine(url: str) -> Engine:
    try:
        return create_engine(url, pool_pre_ping=True)
    except (ArgumentError, NoSuchModuleError) as error:
        raise ConfigError(f"{url!r} is not a database URL that SQLAlchemy knows: {error}") from error
    except ModuleNotFoundError as error:
        raise MissingDependencyError(f"the catalog needs the package {error.name}: pip install {error.name}") from error


def url_without_password(url: str) -> str:
    """What may lie in a file: the password comes from the driver's own places (``PGPASSWORD``, ``~/.pgpass``)."""
    return make_url(url)._replace(password=None).render_as_string(hide_password=False)


@contextlib.contextmanager
def explained(folder: Path) -> Iterator[None]:
    """Turn what a database says into one line of ours."""
    try:
        yield
    except GsmapError:
        raise
    except SQLAlchemyError as error:
        if isinstance(getattr(error, "orig", None), GsmapError):  # a value that a column type refused
            raise error.orig from None  # type: ignore[attr-defined]
        said = str(getattr(error, "orig", None) or error).strip().splitlines()[0]
        low = said.lower()
        if "locked" in low or "busy" in low:
            raise BusyError(f"{folder}: another process holds the catalog; try again later ({said})") from error
        if "malformed" in low or "not a database" in low or "i/o error" in low:
            raise CorruptError(
                f"{folder}: the catalog is damaged ({said}); restore map.sqlite from a backup"
            ) from error
        if "readonly" in low or "read-only" in low:
            raise StoreError(f"{folder} is on a read-only disk: nothing was changed") from error
        if "is full" in low or "no space" in low:
            raise StoreError(f"{folder}: the disk is full; nothing was changed") from error
        if "unable to open" in low:
            raise StoreError(
                f"{folder}: the catalog cannot be opened ({said}); check the folder's permissions"
            ) from error
        if "password" in low:
            raise StoreError(
                f"{folder}: the catalog's server wants another password ({said}): give it in PGPASSWORD or ~/.pgpass"
            ) from error
        if isinstance(error, DBAPIError):
            raise StoreError(f"{folder}: the catalog refused: {said}") from error
        raise
    except OSError as error:
        raise StoreError(f"{folder}: {error.strerror or error}; nothing was changed") from error


def now() -> str:
    """The current time, ISO 8601, UTC."""
    return datetime.now(UTC).isoformat(timespec="microseconds")

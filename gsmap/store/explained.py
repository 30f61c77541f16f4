"""What databases and operating systems say, in our words: told apart by their codes, true of the map's state."""

from __future__ import annotations

import contextlib
import errno
import os
import sqlite3
from collections.abc import Iterator
from pathlib import Path

from sqlalchemy.exc import DBAPIError, MultipleResultsFound, NoResultFound, SQLAlchemyError, StatementError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError

from gsmap.errors import (
    BusyError,
    CorruptError,
    DiskError,
    DiskFullError,
    GsmapError,
    ReadOnlyError,
    StoreError,
    of_system,
)
from gsmap.store import sqlite

NOT_KEPT = "this step was not kept, what was finished before it is"
"""Of an error inside a transaction: it was rolled back."""

UNCERTAIN = "whether this last step was kept shows once that is mended; what was finished before it is kept"
"""Of an error while a transaction was committed: the disk or the connection failed when its bytes were on their way."""

LITTLE_BYTES = 64 << 10  # with less than this left a disk is full: SQLite's index of its log alone takes half of it

_Said = tuple[type[StoreError], str, str, str]  # the error, its code, what is wrong, and what to do
PRUNE_MAY = " (gsmap prune may)"
_FULL: _Said = (DiskFullError, "disk_full", "the disk is full", f"free some space{PRUNE_MAY} and try again")
_READ_ONLY: _Said = (ReadOnlyError, "read_only", "the disk is read-only", "")
_DENIED: _Said = (ReadOnlyError, "no_permission", "permission is missing", "check who may read and write there")
_FAILED: _Said = (
    DiskError,
    "disk_failed",
    "the disk failed",
    "run gsmap check once it works (a quota that is used up looks the same)",
)
_TOO_MANY: _Said = (StoreError, "too_many_open_files", "too many files are open", "raise the limit (ulimit -n)")
_REFUSED: _Said = (StoreError, "system_refused", "the system refused", "")
_BUSY: _Said = (BusyError, "catalog_busy", "another process holds the catalog", "try again later")
_SAID_NO: _Said = (StoreError, "catalog_refused", "the catalog refused", "")
_GONE: _Said = (StoreError, "server_lost", "the catalog's server went away", "try again once it is back")
_PASSWORD: _Said = (
    StoreError,
    "password_refused",
    "the catalog's server wants another password",
    "give it in PGPASSWORD or ~/.pgpass",
)


_CALLED: dict[Path, str] = {}


def call(folder: Path, name: str) -> None:
    """Let a folder that stands for something else be called by that in messages."""
    _CALLED[folder] = name


def called(folder: Path) -> str:
    """What a folder is called in messages."""
    return _CALLED.get(folder, str(folder))


@contextlib.contextmanager
def explained(folder: Path, state: str = "", *, committing: bool = False) -> Iterator[None]:
    """Turn what a database or the operating system says into one line of ours.

    Args:
        folder: of the map or whatever else is worked on.
        state: what became of the step that failed, such as `NOT_KEPT`; empty where nothing was to change.
        committing: the step may have been kept all the same where the disk or the server failed.

    Raises:
        DiskFullError, ReadOnlyError, DiskError, BusyError, CorruptError, StoreError: see there.
    """
    try:
        yield
    except GsmapError:
        raise
    except (SQLAlchemyError, sqlite3.Error) as error:
        said = _database_said(error, folder)
        if said is None:
            raise
        uncertain = committing and said[:3] in (_FAILED[:3], _GONE[:3])
        raise _error(folder, said, _text(error), UNCERTAIN if uncertain else state) from error
    except OSError as error:
        where = Path(os.fsdecode(error.filename)) if isinstance(error.filename, (str, bytes)) else folder
        raise _error(where, _system_said(error), error.strerror or str(error), state) from error


def _system_said(error: OSError) -> _Said:
    kind = of_system(error)
    if kind is DiskFullError:
        return _FULL
    if kind is DiskError:
        return _FAILED
    if kind is ReadOnlyError:
        return _READ_ONLY if error.errno == errno.EROFS else _DENIED
    return _TOO_MANY if error.errno in (errno.EMFILE, errno.ENFILE) else _REFUSED


def is_full(folder: Path) -> bool:
    """Whether the disk that a folder lies on has no room left for us, in bytes or in files."""
    try:
        disk = os.statvfs(folder)
    except OSError:
        return False
    blocks, inodes = (disk.f_bfree, disk.f_ffree) if os.geteuid() == 0 else (disk.f_bavail, disk.f_favail)
    return blocks * disk.f_frsize < LITTLE_BYTES or (disk.f_files > 0 and inodes == 0)


def sqlite_code(error: BaseException) -> int | None:
    """The (extended) result code of SQLite behind an error; None where it is not one of SQLite's."""
    found: object = getattr(error, "orig", None) or error
    code = getattr(found, "sqlite_errorcode", None)
    return code if isinstance(code, int) else None


def _error(where: Path, said: _Said, text: str, state: str) -> StoreError:
    kind, code, what, advice = said
    return kind("; ".join(part for part in (f"{called(where)}: {what} ({text})", state, advice) if part), code=code)


def _text(error: BaseException) -> str:
    lines = str(getattr(error, "orig", None) or error).strip().splitlines()
    return lines[0] if lines else type(error).__name__


def _database_said(error: SQLAlchemyError | sqlite3.Error, folder: Path) -> _Said | None:
    if isinstance(error, StatementError) and isinstance(error.orig, GsmapError):
        raise error.orig from error  # one of ours, on its way through SQLAlchemy
    if isinstance(error, (NoResultFound, MultipleResultsFound)):
        return CorruptError, "catalog_invalid", "the catalog lacks a row, or has it twice", "restore it from a backup"
    code = sqlite_code(error)
    if code is not None:
        return _sqlite_said(code, folder)
    if isinstance(error, PoolTimeoutError):
        return BusyError, "catalog_busy", "too many threads use the catalog", "try again later"
    state = getattr(getattr(error, "orig", None), "sqlstate", None)
    if isinstance(state, str):
        return _server_said(state)
    if "password" in _text(error).lower():  # while connecting there is no code yet
        return _PASSWORD
    return _SAID_NO if isinstance(error, (DBAPIError, sqlite3.Error)) else None


def _sqlite_said(code: int, folder: Path) -> _Said:
    """What a result code of SQLite means here; https://www.sqlite.org/rescode.html."""
    primary = code & 0xFF
    if primary in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED, sqlite3.SQLITE_PROTOCOL):
        return _BUSY
    if primary == sqlite3.SQLITE_FULL:
        return _FULL
    if primary in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB):
        found = sqlite.damage(folder / sqlite.FILE)  # nothing is called damaged on one code's word
        if found:
            return (
                CorruptError,
                "catalog_damaged",
                f"the catalog is damaged: {summary(found)}",
                "restore map.sqlite from a backup",
            )
        return (
            StoreError,
            "catalog_unreadable",
            "the catalog could not be read",
            "its bytes are as they were written: try again",
        )
    if primary == sqlite3.SQLITE_NOMEM or code == sqlite3.SQLITE_IOERR_NOMEM:
        return StoreError, "out_of_memory", "there is not enough memory", ""
    if code == sqlite3.SQLITE_READONLY_DBMOVED:
        return StoreError, "catalog_moved", "the catalog was moved or replaced while it was open", "open the map again"
    if primary in (sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_READONLY, sqlite3.SQLITE_PERM):
        return _disk_said(primary, folder)
    return _SAID_NO


def _disk_said(primary: int, folder: Path) -> _Said:
    """SQLite does not hand on the system's own code, so the disk is asked.

    A full disk has many faces: the log cannot be made (CANTOPEN), its index cannot (READONLY) or cannot grow (IOERR).
    """
    try:
        os.close(os.open(folder, os.O_RDONLY | os.O_DIRECTORY))
        if os.statvfs(folder).f_flag & os.ST_RDONLY and primary != sqlite3.SQLITE_IOERR:
            return _READ_ONLY
    except OSError as error:
        return _system_said(error)
    if is_full(folder):
        return _FULL
    if primary == sqlite3.SQLITE_IOERR:
        return _FAILED
    if primary == sqlite3.SQLITE_CANTOPEN and os.access(folder, os.W_OK):
        return StoreError, "catalog_unreadable", "the catalog cannot be opened", "check who may read and write it"
    return _DENIED


def _server_said(state: str) -> _Said:
    """What an SQLSTATE of PostgreSQL means here; appendix A of its manual."""
    if state == "53100":
        return (
            DiskFullError,
            "disk_full",
            "the disk of the catalog's server is full",
            "free some space there and try again",
        )
    if state == "58030":
        return DiskError, "disk_failed", "the disk of the catalog's server failed", "look at the server's log"
    if state == "25006":
        return ReadOnlyError, "read_only", "the catalog's server lets nobody write", ""
    if state in ("XX001", "XX002"):
        return (
            CorruptError,
            "catalog_damaged",
            "the catalog's server finds its own data damaged",
            "restore that database from a backup",
        )
    if state in ("40001", "40P01", "53300", "55P03", "57P03"):
        return BusyError, "catalog_busy", "the catalog's server is busy", "try again later"
    if state.startswith("28"):
        return _PASSWORD
    return _GONE if state.startswith(("08", "57P")) else _SAID_NO


def summary(found: list[str], most: int = 3) -> str:
    """The first findings, and how many more there are."""
    more = f", and {len(found) - most} more" if len(found) > most else ""
    return ", ".join(found[:most]) + more

"""Translate errors of databases and the operating system to gsmap errors, by error code and the state of the disk."""

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
    failed_path,
    of_system,
)
from gsmap.store import sqlite

NOT_KEPT = "this step was undone; earlier steps are kept"
"""The consequence of an error inside a transaction, which was rolled back."""

UNCERTAIN = "this last step may or may not be kept; earlier steps are kept"
"""The consequence of a disk or connection failure during a commit."""

LITTLE_BYTES = 64 << 10  # a disk with less is full: the index of SQLite's log alone takes half of it

_Explanation = tuple[type[StoreError], str, str, str]  # error class, code, problem, advice
PRUNE_MAY = " (gsmap prune may)"
_FULL: _Explanation = (DiskFullError, "disk_full", "the disk is full", "free some space and try again")
_READ_ONLY: _Explanation = (ReadOnlyError, "read_only", "the disk is read-only", "")
_DENIED: _Explanation = (ReadOnlyError, "no_permission", "permission is missing", "check who may read and write there")
_FAILED: _Explanation = (
    DiskError,
    "disk_failed",
    "the disk failed",
    "run gsmap check once the disk works (an exhausted quota looks the same)",
)
_TOO_MANY: _Explanation = (StoreError, "too_many_open_files", "too many files are open", "raise the limit (ulimit -n)")
_REFUSED: _Explanation = (StoreError, "system_refused", "the system refused", "")
_BUSY: _Explanation = (BusyError, "catalog_busy", "another process holds the catalog", "try again later")
_CATALOG_REFUSED: _Explanation = (StoreError, "catalog_refused", "the catalog refused", "")
_GONE: _Explanation = (
    StoreError,
    "server_lost",
    "the connection to the catalog's server was lost",
    "try again once the server is reachable",
)
_PASSWORD: _Explanation = (
    StoreError,
    "password_refused",
    "the catalog's server rejected the password",
    "set it in PGPASSWORD or ~/.pgpass",
)


_DISPLAY_NAMES: dict[Path, str] = {}
_STAGED: dict[Path, Path] = {}


def set_display_name(folder: Path, name: str) -> None:
    """Set the name that messages use for a folder, such as the URL of a local mirror."""
    _DISPLAY_NAMES[folder] = name


def display_name(path: Path) -> str:
    """Return the name that messages use for a path."""
    for folder in (path, *path.parents):
        name = display_name(_STAGED[folder]) if folder in _STAGED else _DISPLAY_NAMES.get(folder)
        if name is not None:
            return name if folder == path else f"{name}/{path.relative_to(folder).as_posix()}"
    return str(path)


@contextlib.contextmanager
def displayed_as(staged: Path, target: Path) -> Iterator[None]:
    """Context in which messages name ``target`` for a folder in which its content is staged."""
    _STAGED[staged] = target
    try:
        yield
    finally:
        _STAGED.pop(staged, None)


def _may_prune(path: Path, folder: Path) -> bool:
    """Return True if `prune` of the map in a folder may free space on the disk of a path."""
    is_map = any((folder / name).is_file() for name in (sqlite.FILE, "catalog.url"))
    return is_map and path.is_relative_to(folder) and not any(part in _STAGED for part in (path, *path.parents))


@contextlib.contextmanager
def translate_errors(folder: Path, state: str = "", *, committing: bool = False) -> Iterator[None]:
    """Translate errors of databases and the operating system to gsmap errors with a one-line message.

    Args:
        folder: folder of the map or of the other files in use.
        state: consequence for the failed step, such as `NOT_KEPT`; empty if nothing was to change.
        committing: the step may have been committed although the disk or the server failed.

    Raises:
        DiskFullError, ReadOnlyError, DiskError, BusyError, CorruptError, StoreError: by the error translated.
    """
    try:
        yield
    except GsmapError:
        raise
    except (SQLAlchemyError, sqlite3.Error) as error:
        explanation = _explain_database(error, folder)
        if explanation is None:
            raise
        uncertain = committing and explanation[:3] in (_FAILED[:3], _GONE[:3])
        raise _error(folder, folder, explanation, _text(error), UNCERTAIN if uncertain else state) from error
    except OSError as error:
        where = Path(failed_path(error) or folder)
        raise _error(where, folder, _explain_system(error), error.strerror or str(error), state) from error


def _explain_system(error: OSError) -> _Explanation:
    kind = of_system(error)
    if kind is DiskFullError:
        return _FULL
    if kind is DiskError:
        return _FAILED
    if kind is ReadOnlyError:
        return _READ_ONLY if error.errno == errno.EROFS else _DENIED
    return _TOO_MANY if error.errno in (errno.EMFILE, errno.ENFILE) else _REFUSED


def is_full(folder: Path) -> bool:
    """Return True if the disk of a folder has no bytes or inodes left for gsmap."""
    try:
        disk = os.statvfs(folder)
    except OSError:
        return False
    blocks, inodes = (disk.f_bfree, disk.f_ffree) if os.geteuid() == 0 else (disk.f_bavail, disk.f_favail)
    return blocks * disk.f_frsize < LITTLE_BYTES or (disk.f_files > 0 and inodes == 0)


def sqlite_code(error: BaseException) -> int | None:
    """Return the (extended) result code of SQLite behind an error; None for other errors."""
    found: object = getattr(error, "orig", None) or error
    code = getattr(found, "sqlite_errorcode", None)
    return code if isinstance(code, int) else None


def _error(where: Path, folder: Path, explanation: _Explanation, text: str, state: str) -> StoreError:
    kind, code, what, advice = explanation
    if explanation is _FULL and _may_prune(where, folder):
        advice = f"free some space{PRUNE_MAY} and try again"
    return kind(
        "; ".join(part for part in (f"{display_name(where)}: {what} ({text})", state, advice) if part), code=code
    )


def _text(error: BaseException) -> str:
    lines = str(getattr(error, "orig", None) or error).strip().splitlines()
    return lines[0] if lines else type(error).__name__


def _explain_database(error: SQLAlchemyError | sqlite3.Error, folder: Path) -> _Explanation | None:
    if isinstance(error, StatementError) and isinstance(error.orig, GsmapError):
        raise error.orig from error  # a gsmap error wrapped by SQLAlchemy
    if isinstance(error, (NoResultFound, MultipleResultsFound)):
        return (
            CorruptError,
            "catalog_invalid",
            "the catalog lacks a row or has a duplicate row",
            "restore it from a backup",
        )
    code = sqlite_code(error)
    if code is not None:
        return _explain_sqlite(code, folder)
    if isinstance(error, PoolTimeoutError):
        return BusyError, "catalog_busy", "too many threads use the catalog", "try again later"
    state = getattr(getattr(error, "orig", None), "sqlstate", None)
    if isinstance(state, str):
        return _explain_server(state)
    if "password" in _text(error).lower():  # errors while connecting have no code
        return _PASSWORD
    return _CATALOG_REFUSED if isinstance(error, (DBAPIError, sqlite3.Error)) else None


def _explain_sqlite(code: int, folder: Path) -> _Explanation:
    """Explain a result code of SQLite; https://www.sqlite.org/rescode.html."""
    primary = code & 0xFF
    if primary in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED, sqlite3.SQLITE_PROTOCOL):
        return _BUSY
    if primary == sqlite3.SQLITE_FULL:
        return _FULL
    if primary in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB):
        found = sqlite.damage(folder / sqlite.FILE)  # verify the file instead of trusting the code
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
            "its bytes are intact: try again",
        )
    if primary == sqlite3.SQLITE_NOMEM or code == sqlite3.SQLITE_IOERR_NOMEM:
        return StoreError, "out_of_memory", "there is not enough memory", ""
    if code == sqlite3.SQLITE_READONLY_DBMOVED:
        return StoreError, "catalog_moved", "the catalog was moved or replaced while it was open", "open the map again"
    if primary in (sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_READONLY, sqlite3.SQLITE_PERM):
        return _explain_disk(primary, folder)
    return _CATALOG_REFUSED


def _explain_disk(primary: int, folder: Path) -> _Explanation:
    """Explain a disk error of SQLite by testing the disk, as SQLite hides the system's error code.

    A full disk causes several codes: the log cannot be created (CANTOPEN), its index cannot (READONLY) or cannot grow
    (IOERR).
    """
    try:
        os.close(os.open(folder, os.O_RDONLY | os.O_DIRECTORY))
        if os.statvfs(folder).f_flag & os.ST_RDONLY and primary != sqlite3.SQLITE_IOERR:
            return _READ_ONLY
    except OSError as error:
        return _explain_system(error)
    if is_full(folder):
        return _FULL
    if primary == sqlite3.SQLITE_IOERR:
        return _FAILED
    if primary == sqlite3.SQLITE_CANTOPEN and os.access(folder, os.W_OK):
        return StoreError, "catalog_unreadable", "the catalog cannot be opened", "check who may read and write it"
    return _DENIED


def _explain_server(state: str) -> _Explanation:
    """Explain an SQLSTATE of PostgreSQL (appendix A of its manual)."""
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
        return ReadOnlyError, "read_only", "the catalog's server is read-only", ""
    if state in ("XX001", "XX002"):
        return (
            CorruptError,
            "catalog_damaged",
            "the catalog's server reports damaged data",
            "restore that database from a backup",
        )
    if state in ("40001", "40P01", "53300", "55P03", "57P03"):
        return BusyError, "catalog_busy", "the catalog's server is busy", "try again later"
    if state.startswith("28"):
        return _PASSWORD
    return _GONE if state.startswith(("08", "57P")) else _CATALOG_REFUSED


def summary(found: list[str], most: int = 3) -> str:
    """List the first findings, and the number of the remaining findings."""
    more = f", and {len(found) - most} more" if len(found) > most else ""
    return ", ".join(found[:most]) + more

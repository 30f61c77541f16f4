"""Every code of SQLite, PostgreSQL and the operating system ends as the right error, with a message that is true."""

import errno
import os
import sqlite3

import pytest
from raising import raises
from sqlalchemy.exc import DBAPIError, StatementError
from store_samples import make_cameras, make_gaussians

from gsmap.errors import (
    BusyError,
    CorruptError,
    DiskError,
    DiskFullError,
    InputError,
    ReadOnlyError,
    StoreError,
    of_system,
)
from gsmap.store import Store, error_translation, sqlite
from gsmap.store.error_translation import NOT_KEPT, UNCERTAIN, translate_errors

ERRORS = {
    "SQLITE_BUSY": BusyError,
    "SQLITE_BUSY_RECOVERY": BusyError,
    "SQLITE_BUSY_SNAPSHOT": BusyError,
    "SQLITE_CANTOPEN": StoreError,
    "SQLITE_CONSTRAINT": StoreError,
    "SQLITE_CORRUPT": StoreError,
    "SQLITE_CORRUPT_VTAB": StoreError,
    "SQLITE_ERROR": StoreError,
    "SQLITE_FULL": DiskFullError,
    "SQLITE_IOERR": DiskError,
    "SQLITE_IOERR_FSYNC": DiskError,
    "SQLITE_IOERR_NOMEM": StoreError,
    "SQLITE_IOERR_READ": DiskError,
    "SQLITE_IOERR_SHMSIZE": DiskError,
    "SQLITE_IOERR_TRUNCATE": DiskError,
    "SQLITE_IOERR_WRITE": DiskError,
    "SQLITE_LOCKED": BusyError,
    "SQLITE_LOCKED_SHAREDCACHE": BusyError,
    "SQLITE_NOMEM": StoreError,
    "SQLITE_NOTADB": StoreError,
    "SQLITE_PERM": ReadOnlyError,
    "SQLITE_PROTOCOL": BusyError,
    "SQLITE_READONLY": ReadOnlyError,
    "SQLITE_READONLY_DBMOVED": StoreError,
    "SQLITE_READONLY_DIRECTORY": ReadOnlyError,
    "SQLITE_SCHEMA": StoreError,
    "SQLITE_TOOBIG": StoreError,
}

STATES = {
    "08006": StoreError,
    "22P02": StoreError,
    "25006": ReadOnlyError,
    "28P01": StoreError,
    "40001": BusyError,
    "40P01": BusyError,
    "53100": DiskFullError,
    "53300": BusyError,
    "55P03": BusyError,
    "57P01": StoreError,
    "57P03": BusyError,
    "58030": DiskError,
    "XX001": CorruptError,
}

CODES = {
    errno.ENOSPC: DiskFullError,
    errno.EDQUOT: DiskFullError,
    errno.EROFS: ReadOnlyError,
    errno.EACCES: ReadOnlyError,
    errno.EPERM: ReadOnlyError,
    errno.EIO: DiskError,
    errno.EMFILE: StoreError,
    errno.ENAMETOOLONG: StoreError,
}


def said(raised: BaseException, folder, state="", **more) -> StoreError:
    with pytest.raises(StoreError) as caught, translate_errors(folder, state, **more):
        raise raised
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(f"{folder}: ")
    return caught.value


def sqlite_error(name: str) -> sqlite3.OperationalError:
    error = sqlite3.OperationalError("what SQLite says\nin two lines")
    error.sqlite_errorcode, error.sqlite_errorname = getattr(sqlite3, name), name
    return error


@pytest.mark.parametrize("name", sorted(ERRORS))
@pytest.mark.parametrize("wrapped", [False, True])
def test_codes_of_sqlite(store, name, wrapped):
    """Nothing is damaged here, so that nothing is called so."""
    error = sqlite_error(name)
    error = DBAPIError("SELECT 1", {}, error) if wrapped else error
    found = said(error, store.folder, "S")
    assert type(found) is ERRORS[name]
    assert "what SQLite says" in str(found)
    assert "; S" in str(found)
    assert "damaged" not in str(found)
    assert "restore" not in str(found)


@pytest.mark.parametrize(
    "name", ["SQLITE_CANTOPEN", "SQLITE_IOERR_SHMSIZE", "SQLITE_IOERR_WRITE", "SQLITE_READONLY_CANTINIT"]
)
def test_a_full_disk_is_known_whatever_sqlite_calls_it(store, monkeypatch, name):
    monkeypatch.setattr(error_translation, "is_full", lambda folder: True)
    found = said(sqlite_error(name), store.folder)
    assert type(found) is DiskFullError
    assert "prune" in str(found)


@pytest.mark.parametrize("state", sorted(STATES))
def test_codes_of_postgresql(tmp_path, state):
    error = RuntimeError("what the server says")
    error.sqlstate = state
    assert type(said(DBAPIError("SELECT 1", {}, error), tmp_path)) is STATES[state]


def test_a_missing_password_has_no_code(tmp_path):
    error = DBAPIError("", {}, RuntimeError("connection failed: fe_sendauth: no password supplied"))
    assert "PGPASSWORD" in str(said(error, tmp_path))


@pytest.mark.parametrize("code", sorted(CODES))
def test_codes_of_the_system(tmp_path, code):
    found = said(OSError(code, os.strerror(code)), tmp_path, NOT_KEPT)
    assert type(found) is CODES[code] is of_system(OSError(code, ""))
    assert os.strerror(code) in str(found)
    assert NOT_KEPT in str(found)
    with raises(StoreError, code=found.code, match=r"^/some/file: "), translate_errors(tmp_path):
        raise OSError(code, os.strerror(code), "/some/file")


def test_our_own_errors_pass(tmp_path):
    ours = InputError("a name with a line break", code="invalid_name")
    for error in (ours, StatementError("", "SELECT 1", {}, ours)):
        with raises(InputError, code="invalid_name"), translate_errors(tmp_path):
            raise error
    with pytest.raises(ZeroDivisionError), translate_errors(tmp_path):
        raise ZeroDivisionError


def test_what_is_damaged_is_called_so(store, two_scenes):
    store.close()
    file = store.folder / sqlite.FILE
    content = bytearray(file.read_bytes())
    content[4096 * 3 : 4096 * 12] = b"\xff" * 4096 * 9
    file.write_bytes(content)
    found = said(sqlite_error("SQLITE_CORRUPT"), store.folder)
    assert type(found) is CorruptError
    assert "restore" in str(found)


@pytest.mark.parametrize(
    ("name", "state"),
    [("SQLITE_IOERR_FSYNC", UNCERTAIN), ("SQLITE_FULL", NOT_KEPT), ("SQLITE_BUSY", NOT_KEPT)],
)
def test_a_failed_commit_says_what_is_certain(store, monkeypatch, name, state):
    dialect = type(store.catalog.engine.dialect)
    real = dialect.do_commit

    def refuse(self, connection):
        if store.catalog._writing is not None:
            raise sqlite_error(name)
        real(self, connection)

    with monkeypatch.context() as patch:
        patch.setattr(dialect, "do_commit", refuse)
        with pytest.raises(StoreError) as caught:
            store.scenes.add(make_gaussians(), make_cameras(), name="a")
    assert state in str(caught.value)
    assert store.scenes.list() == []
    assert store.check().ok


def test_a_log_that_cannot_be_folded_in_costs_nothing(tmp_path, monkeypatch, caplog):
    """What is committed is in the log: the verb has done its work, and the next one folds it in."""

    def refuse(*arguments, **more):
        raise sqlite_error("SQLITE_IOERR_WRITE")

    with Store.create(tmp_path / "m") as store:
        with monkeypatch.context() as patch:
            patch.setattr(sqlite, "checkpoint", refuse)
            store.scenes.add(make_gaussians(), make_cameras(), name="a")
        assert "kept" in caplog.text
        with monkeypatch.context() as patch:
            patch.setattr(sqlite, "checkpoint", refuse)
            store.close()
    with Store.open(tmp_path / "m") as store:
        assert [s.name for s in store.scenes.list()] == ["a"]
        assert store.check().ok


def test_a_disk_that_cannot_read_is_no_damage(store, two_scenes, monkeypatch):
    """Reading arrays fails as the disk does; check names the file and goes on."""
    from gsmap.store import arrays

    def refuse(*arguments, **more):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    with monkeypatch.context() as patch:
        patch.setattr(arrays.os, "pread", refuse)
        with raises(DiskError, code="disk_failed"):
            store.scenes.gaussians("scene0")
    with monkeypatch.context() as patch:
        patch.setattr(arrays.hashlib, "file_digest", refuse)
        problems = store.check().problems
    assert len(problems) >= 2
    assert all("cannot be read" in problem for problem in problems)
    assert store.check().ok

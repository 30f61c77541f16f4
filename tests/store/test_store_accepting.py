"""A catalog without digests, one that a person accepts, one that a backup took the place of."""

import hashlib
import json
import os
import shutil
import sqlite3
from pathlib import Path

import pytest
from page_samples import PAGE, flip
from raising import raises

from gsmap.errors import CorruptError, StoreError
from gsmap.store import Store, page_digests, sqlite


def without_digests(path: Path) -> None:
    page_digests.digests_path(path / sqlite.FILE).unlink()


def test_what_cannot_be_verified_is_said(closed):
    without_digests(closed)
    with Store.open(closed, "r") as store:
        report = store.check()
    assert report.ok
    assert "older gsmap" in report.unverified[0]
    with Store.open(closed) as store:
        store.scenes.edit("monday", note="a write")
    with Store.open(closed, "r") as store:
        assert store.check().unverified == ()


def test_the_note_of_an_older_gsmap_counts_until_the_next_write(closed):
    file = closed / sqlite.FILE
    without_digests(closed)
    note, stamp = page_digests.legacy_digest_path(file), file.stat()
    sha256 = hashlib.sha256(file.read_bytes()).hexdigest()
    note.write_text(json.dumps({"sha256": sha256, "size_bytes": stamp.st_size, "mtime_ns": stamp.st_mtime_ns}))
    Store.open(closed, "r").close()
    flip(file, stamp.st_size - 50)
    os.utime(file, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
    with raises(CorruptError, code="catalog_damaged"):
        Store.open(closed)
    flip(file, stamp.st_size - 50)  # another time now
    with Store.open(closed) as store:
        assert note.exists()
        store.scenes.edit("monday", note="a write")
    assert not note.exists()
    assert page_digests.load(file) is not None


def test_damage_is_not_taken_for_what_was_written_where_there_are_no_digests(closed):
    without_digests(closed)
    file = closed / sqlite.FILE
    store = Store.open(closed)
    store.scenes.edit("monday", note="a write")
    with open(file, "rb+") as opened:
        opened.seek(4 * PAGE)
        opened.write(b"\xff" * PAGE * 3)
    with pytest.raises(CorruptError):
        store.close()
    assert not page_digests.digests_path(file).exists()


def test_a_person_accepts_the_catalog(closed):
    with sqlite3.connect(closed / sqlite.FILE) as connection:  # as the sqlite3 program does
        connection.execute("UPDATE scenes SET name = 'renamed' WHERE name = 'monday'")
    connection.close()
    with raises(CorruptError, code="catalog_damaged", match="accept-catalog"):
        Store.open(closed)
    (said,) = Store.accept_catalog(closed)
    assert "map.sqlite" in said
    with Store.open(closed) as store:
        assert [s.name for s in store.scenes.list()] == ["renamed", "tuesday"]
        assert store.check().problems == ()
    assert Store.accept_catalog(closed) == []


def test_what_sqlite_finds_broken_cannot_be_accepted(closed):
    noted = page_digests.load(closed / sqlite.FILE)
    with open(closed / sqlite.FILE, "rb+") as opened:
        opened.seek(4 * PAGE)
        opened.write(b"\xff" * PAGE * 8)
    with pytest.raises(StoreError):
        Store.accept_catalog(closed)
    assert page_digests.load(closed / sqlite.FILE) == noted


def test_a_backup_that_was_put_back_is_known(closed):
    file = closed / sqlite.FILE
    with Store.open(closed) as store:
        store.catalog.copy(closed / "map.sqlite.0002.bak")
        store.scenes.edit("monday", name="renamed")
    shutil.copyfile(closed / "map.sqlite.0002.bak", file)
    with Store.open(closed, "r") as store:
        assert store.scenes.list()[0].name == "monday"
    with Store.open(closed) as store:
        store.scenes.remove("monday")
    with Store.open(closed) as store:
        assert store.check().ok

"""What a log holds is what SQLite finds in it; what SQLite would drop of it without a word is found."""

import random
import shutil
import sqlite3

import pytest
from page_samples import PAGE, fill, flip
from raising import raises
from store_samples import make_cameras, make_gaussians

from gsmap.errors import CorruptError
from gsmap.store import Store, sqlite
from gsmap.store.wal import read_index_header, read_log, wal_path


@pytest.fixture
def killed(tmp_path):
    """A map whose writer was killed: a log with ten commits, and its index."""
    path = tmp_path / "site.gsmap"
    Store.create(path).close()
    store = Store.open(path)
    fill(store, 10)
    shutil.copytree(path, tmp_path / "killed.gsmap")
    store.close()
    return tmp_path / "killed.gsmap"


@pytest.mark.parametrize("count", [25, pytest.param(200, marks=pytest.mark.slow)])
@pytest.mark.guards("data")
def test_a_flip_in_the_log_is_found(killed, count):
    log = wal_path(killed / sqlite.FILE)
    rng = random.Random(1)
    for _ in range(count):
        at = rng.randrange(log.stat().st_size)
        flip(log, at)
        with raises(CorruptError, code="catalog_damaged"):
            Store.open(killed)
        flip(log, at)
    with Store.open(killed) as store:
        assert len(store.exports.list()) == 10


def test_a_torn_end_of_the_log_is_no_damage(killed):
    """A power cut leaves what was not synchronised in any order; it was not acknowledged either."""
    log = wal_path(killed / sqlite.FILE)
    log.with_name("map.sqlite-shm").unlink()
    whole = log.read_bytes()
    frame = PAGE + 24
    commits = [i for i in range(32, len(whole), frame) if int.from_bytes(whole[i + 4 : i + 8], "big")]
    last = range(commits[-2] + frame, len(whole), frame)
    assert len(last) > 2
    for lost in last:
        log.write_bytes(whole[:lost] + bytes(frame) + whole[lost + frame :])
        assert read_log(log).problem == ""
    for cut in (len(whole) - 1, len(whole) - 3 * frame - 100, 32, 20, 0):
        log.write_bytes(whole[:cut])
        assert read_log(log).problem == ""
    log.write_bytes(whole[: last[0] + 50])
    with Store.open(killed) as store:
        assert len(store.exports.list()) == 9
        assert store.check().ok


@pytest.mark.guards("data")
@pytest.mark.parametrize("commits_lost", [1, 4])
def test_a_log_that_ends_before_the_commits_that_were_acknowledged_is_damage(killed, commits_lost):
    """Its index names the last one: a whole, shorter log is no torn end."""
    log = wal_path(killed / sqlite.FILE)
    whole = log.read_bytes()
    frame = PAGE + 24
    commits = [i for i in range(32, len(whole), frame) if int.from_bytes(whole[i + 4 : i + 8], "big")]
    log.write_bytes(whole[: commits[-1 - commits_lost] + frame])
    assert read_log(log, read_index_header(killed / sqlite.FILE)).problem
    with raises(CorruptError, code="catalog_damaged"):
        Store.open(killed)
    log.write_bytes(whole)
    with Store.open(killed) as store:
        assert len(store.exports.list()) == 10


def test_the_log_is_read_as_sqlite_reads_it(killed):
    file = killed / sqlite.FILE
    log = read_log(wal_path(file), read_index_header(file))
    content = bytearray(file.read_bytes().ljust(log.num_pages * PAGE, b"\0"))
    frames = wal_path(file).read_bytes()
    for number, at in log.frames.items():
        content[(number - 1) * PAGE : number * PAGE] = frames[at : at + PAGE]
    with sqlite3.connect(file) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    connection.close()
    assert file.read_bytes() == content


def test_adding_to_a_map_whose_log_was_left_behind(killed):
    with Store.open(killed) as store:
        store.scenes.add(make_gaussians(), make_cameras(), name="a")
        assert store.check().ok
    assert not wal_path(killed / sqlite.FILE).exists()

"""A damaged page of the catalog is found, whatever happened to the map since; a sound one is never called damaged."""

import contextlib
import os
import random
import shutil
from pathlib import Path

import pytest
import store_children
from page_samples import PAGE, fill, flip
from raising import raises
from store_children import messages

from gsmap.errors import CorruptError, DiskError
from gsmap.store import Store, page_digests, sqlite
from gsmap.store.file_handles import FileHandle
from gsmap.store.wal import read_log, wal_path
from tools.check import flips as check_flips


@pytest.mark.parametrize("count", [12, pytest.param(200, marks=pytest.mark.slow)])
def test_every_flip_is_found(closed, count):
    found, listed, of_catalog = check_flips.count_found(closed, count)
    assert found == dict.fromkeys(check_flips.WAYS, count)
    assert listed == of_catalog > 0
    assert check_flips.checks(closed)


@pytest.mark.guards("data")
def test_a_flip_in_each_page_and_in_its_digest_is_named(closed):
    file = closed / sqlite.FILE
    noted = page_digests.load(file)
    assert noted.count * PAGE == file.stat().st_size
    for number in range(1, noted.count + 1):
        at = (number - 1) * PAGE + 100 + number
        flip(file, at)
        with raises(CorruptError, code="catalog_damaged", match=f"page {number} "):
            Store.open(closed, "r")
        flip(file, at)
    side = page_digests.digests_path(file)
    for at in range(0, side.stat().st_size, 31):
        flip(side, at)
        with raises(CorruptError, code="catalog_damaged"):
            Store.open(closed, "r")
        flip(side, at)
    Store.open(closed, "r").close()


def test_a_longer_and_a_shorter_file_are_found(closed):
    file = closed / sqlite.FILE
    whole = file.read_bytes()
    for content in (whole + bytes(PAGE), whole[:-PAGE], whole[:-7], whole + b"x"):
        file.write_bytes(content)
        with pytest.raises(CorruptError):
            Store.open(closed, "r")
    file.write_bytes(whole)
    Store.open(closed, "r").close()


@pytest.mark.guards("data")
def test_damage_that_comes_while_a_map_is_open_is_not_blessed(closed):
    """The next fold looks first: what was written stays in the log, and the damage stays to be seen."""
    store = Store.open(closed)
    file = closed / sqlite.FILE
    noted = page_digests.load(file)
    flip(file, file.stat().st_size - 50)
    store.scenes.edit("monday", note="seen")  # in the log
    with raises(CorruptError, code="catalog_damaged", match=f"page {noted.count} "):
        store.close()
    assert page_digests.load(file) == noted
    for mode in "rw":
        with pytest.raises(CorruptError):
            Store.open(closed, mode)
    assert wal_path(file).stat().st_size
    flip(file, file.stat().st_size - 50)
    with Store.open(closed) as store:  # nothing is lost once the page is as it was
        assert "note" in [fact.kind for fact in store.scenes.facts("monday")]
        assert store.check().ok
    assert page_digests.load(file) != noted


def stages_of_a_fold(path: Path, copies: Path, monkeypatch) -> list[Path]:
    """The map as a kill would leave it at each step of folding the log in."""
    copies.mkdir()

    def keep(name: str) -> Path:
        shutil.copytree(path, copies / name)
        return copies / name

    real_save, real_fold = page_digests.save, sqlite._checkpoint_truncate

    def save(file, noted):
        keep(f"{len(list(copies.iterdir()))} before digests")
        real_save(file, noted)
        keep(f"{len(list(copies.iterdir()))} after digests")

    def folded(engine):
        done = real_fold(engine)
        keep(f"{len(list(copies.iterdir()))} after the fold")
        return done

    store = Store.open(path)
    fill(store, 8)
    with monkeypatch.context() as patch:
        patch.setattr(page_digests, "save", save)
        patch.setattr(sqlite, "_checkpoint_truncate", folded)
        store.close()
    out = sorted(copies.iterdir())
    assert len(out) == 5
    return out


@pytest.mark.guards("data")
def test_killed_anywhere_in_a_fold(closed, tmp_path, monkeypatch):
    stages = stages_of_a_fold(closed, tmp_path / "stages", monkeypatch)
    before, under_way, after = (stages[i] / sqlite.FILE for i in (1, 1, 2))
    noted = page_digests.load(before)
    assert noted.next_count > noted.count
    # In the middle some pages are new, some old, some not there yet; a power cut may tear the one being written.
    rng = random.Random(3)
    for i in range(6):
        torn = tmp_path / "stages" / f"torn {i}"
        shutil.copytree(stages[1], torn)
        new, content = after.read_bytes(), bytearray(under_way.read_bytes())
        written = sorted(n for n in noted.next if rng.random() < i / 5)
        for number in written:
            content.extend(bytes(max(0, number * PAGE - len(content))))
            content[(number - 1) * PAGE : number * PAGE] = new[(number - 1) * PAGE : number * PAGE]
        if i % 2 and written:
            content[(written[-1] - 1) * PAGE + 512 : written[-1] * PAGE] = bytes(PAGE - 512)
        (torn / sqlite.FILE).write_bytes(content)
        stages.append(torn)
    for stage in stages:
        with Store.open(stage, "r") as store:
            assert store.check().problems == (), stage.name
        # What no fold was about to change is verified all the same.
        spare = next(n for n in range(1, noted.count + 1) if n not in noted.next)
        flip(stage / sqlite.FILE, spare * PAGE - 9)
        with raises(CorruptError, code="catalog_damaged", match=f"page {spare} "):
            Store.open(stage)
        flip(stage / sqlite.FILE, spare * PAGE - 9)
        with Store.open(stage) as store:
            assert len(store.exports.list()) == 8
            store.scenes.edit("monday", note="after the kill")
        assert page_digests.load(stage / sqlite.FILE).next_count == 0
        with Store.open(stage, "r") as store:
            assert store.check().problems == ()


@pytest.mark.guards("data")
def test_a_page_that_is_missing_while_a_fold_is_under_way_is_found(closed, tmp_path, monkeypatch):
    """Only pages that the fold itself adds may be missing from the end of the file."""
    under_way = stages_of_a_fold(closed, tmp_path / "stages", monkeypatch)[1]
    file = under_way / sqlite.FILE
    noted = page_digests.load(file)
    assert noted.next_count > noted.count
    os.truncate(file, (noted.count - 1) * PAGE)
    with contextlib.closing(FileHandle(file)) as handle:
        found = page_digests.problems(file, handle, noted, read_log(wal_path(file)))
    assert any(f" {noted.count}" in problem for problem in found), found
    with raises(CorruptError, code="catalog_damaged"):
        Store.open(under_way)


def test_a_catalog_that_shrinks(closed, tmp_path, monkeypatch):
    with Store.open(closed) as store:
        fill(store, 8)
    with Store.open(closed) as store:
        store.exports.begin("/out/more", revision=None)
        with store.catalog.write() as connection:
            connection.exec_driver_sql("DELETE FROM exports")
    before = (closed / sqlite.FILE).stat().st_size
    store = Store.open(closed)
    raw = store.catalog.engine.raw_connection()
    raw.driver_connection.execute("VACUUM")
    raw.close()
    real = sqlite._checkpoint_truncate

    def folded(engine):
        shutil.copytree(closed, tmp_path / "before")
        done = real(engine)
        shutil.copytree(closed, tmp_path / "after")
        return done

    with monkeypatch.context() as patch:
        patch.setattr(sqlite, "_checkpoint_truncate", folded)
        store.close()
    assert (closed / sqlite.FILE).stat().st_size < before
    for path in (tmp_path / "before", tmp_path / "after", closed):
        for mode in "rwr":
            with Store.open(path, mode) as store:
                assert store.check().problems == ()
                assert len(store.scenes.list()) == 2


def test_a_page_that_was_folded_in_is_verified_without_the_log(closed, tmp_path, monkeypatch):
    """Killed between the fold and its last note, pages may be old or new, and nothing else."""
    stage = stages_of_a_fold(closed, tmp_path / "stages", monkeypatch)[2]
    assert not wal_path(stage / sqlite.FILE).exists() or not wal_path(stage / sqlite.FILE).stat().st_size
    for number in page_digests.load(stage / sqlite.FILE).next:
        flip(stage / sqlite.FILE, number * PAGE - 9)
        with raises(CorruptError, code="catalog_damaged", match=f"page {number} "):
            Store.open(stage, "r")
        flip(stage / sqlite.FILE, number * PAGE - 9)


@pytest.mark.guards("data")
def test_a_reader_that_keeps_the_log_from_being_folded_in(closed, monkeypatch):
    monkeypatch.setattr(sqlite, "_READERS_S", 0.05)
    file = closed / sqlite.FILE
    with Store.open(closed) as store, Store.open(closed, "r") as reader:
        fill(store)
        with reader.catalog.read() as connection:
            connection.exec_driver_sql("SELECT count(*) FROM exports").scalar()
            monkeypatch.setattr(sqlite, "CHECKPOINT_BYTES", 1)
            fill(store)
            assert page_digests.load(file).next_count
            Store.open(closed, "r").close()
            fill(store)
            assert store.check().problems == ()
        fill(store)
        assert not page_digests.load(file).next_count
        assert store.check().problems == ()
    assert not wal_path(file).exists()
    with Store.open(closed, "r") as store:
        assert len(store.exports.list()) == 12


def test_many_open_it_while_others_fold(tmp_path, start, context):
    path = tmp_path / "m"
    Store.create(path).close()
    stop = context.Event()
    readers = [start(store_children.open_often, str(path), mode, stop) for mode in "rrw"]
    writers = [start(store_children.fold_often, str(path), i, 25) for i in range(3)]
    for process, pipe in writers:
        process.join(120)
        assert messages(pipe) == ["done"]
    stop.set()
    for process, pipe in readers:
        process.join(120)
        (rounds,) = messages(pipe)
        assert isinstance(rounds, int), rounds
    with Store.open(path) as store:
        assert len(store.exports.list()) == 75
        assert store.check().problems == ()


@pytest.mark.guards("data")
def test_reading_the_file_drops_no_lock_of_sqlite(tmp_path, start):
    """Closing a handle on a file drops the process's locks on it; then another one that closes the map would take
    itself for the last, remove the log, and what this one writes from then on would be lost."""
    path = tmp_path / "m"
    seen = []
    with Store.create(path) as store:
        sqlite.checkpoint(store.catalog.engine, path / sqlite.FILE, at_bytes=1)
        for seed in range(3):
            store_children.add(store, seed)
            store.check()
            process, pipe = start(store_children.open_and_close, str(path))
            process.join()
            seen += messages(pipe)
        with Store.open(path, "r") as other:
            other.check()
        store_children.add(store, 3)
        process, pipe = start(store_children.open_and_close, str(path))
        process.join()
        seen += messages(pipe)
    names = [f"scene{i}" for i in range(4)]
    assert seen == [names[:1], names[:2], names[:3], names]


@pytest.mark.guards("data")
def test_handles_are_shared_and_closed_with_the_last(tmp_path):
    (tmp_path / "a").write_bytes(b"x")
    one, two = FileHandle(tmp_path / "a"), FileHandle(tmp_path / "a")
    assert one.number == two.number
    one.close()
    one.close()
    assert Path(f"/proc/self/fd/{two.number}").exists()
    two.close()
    assert not Path(f"/proc/self/fd/{two.number}").exists()


def test_a_store_that_is_never_closed_does_not_fold_past_the_digests(tmp_path):
    path = tmp_path / "m"
    Store.create(path).close()
    store = Store.open(path)
    fill(store)
    noted = page_digests.load(path / sqlite.FILE)
    del store
    import gc

    gc.collect()
    assert wal_path(path / sqlite.FILE).stat().st_size
    assert page_digests.load(path / sqlite.FILE) == noted
    with Store.open(path) as store:
        assert len(store.exports.list()) == 3
        assert store.check().ok


def test_more_threads_than_connections_are_kept(store, two_scenes):
    from concurrent.futures import ThreadPoolExecutor
    from threading import Barrier

    together = Barrier(12)

    def count(_: int) -> int:
        with store.catalog.read() as connection:
            together.wait(30)
            return connection.exec_driver_sql("SELECT count(*) FROM scenes").scalar()

    with ThreadPoolExecutor(12) as pool:
        assert list(pool.map(count, range(12))) == [2] * 12


def test_a_long_catalog_is_verified_by_check_alone(closed, monkeypatch):
    """Opening it takes no seconds then, and a write blesses no damage: neither in pages it changes nor in others."""
    monkeypatch.setattr(page_digests, "WHOLE_BYTES", 1000)
    file = closed / sqlite.FILE
    flip(file, file.stat().st_size - 50)
    with Store.open(closed, "r") as store:
        assert "differs" in store.check().problems[0]
    with Store.open(closed) as store:
        store.scenes.edit("monday", note="a write elsewhere")
    with Store.open(closed, "r") as store:
        assert "differs" in store.check().problems[0]
    flip(file, file.stat().st_size - 50)
    store = Store.open(closed)
    store.scenes.edit("monday", note="a write there")
    number = min(read_log(wal_path(file)).frames)
    flip(file, number * PAGE - 50)
    with raises(CorruptError, code="catalog_damaged", match=f"page {number} "):
        store.close()
    flip(file, number * PAGE - 50)
    with Store.open(closed) as store:
        assert store.check().ok


def test_digests_survive_their_own_format(tmp_path):
    noted = page_digests.PageDigests(PAGE, bytes(range(64)), 9, {7: b"a" * 16, 2: b"b" * 16})
    (tmp_path / "x").touch()
    for name in (".x.digests.0a1b2c3d", ".x.sha256", "x.sha256"):  # what a kill and an older gsmap left
        (tmp_path / name).touch()
    page_digests.save(tmp_path / "x", noted)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["x", "x.digests"]
    assert page_digests.load(tmp_path / "x") == noted
    assert page_digests.format_pages([1, 2, 3, 7, 9, 10]) == "pages 1-3, 7, 9-10"


def test_a_catalog_in_another_journal_mode_is_refused_until_it_is_accepted(closed):
    """What is written in any other mode goes past the digests."""
    import sqlite3

    file = closed / sqlite.FILE
    with sqlite3.connect(file) as connection:
        assert connection.execute("PRAGMA journal_mode = DELETE").fetchone() == ("delete",)
    connection.close()
    page_digests.write_digests(file)
    with raises(CorruptError, code="catalog_damaged", match="journal mode.*--accept-catalog"):
        Store.open(closed)
    Store.accept_catalog(closed)
    with Store.open(closed) as store:
        store.scenes.edit(store.scenes.list()[0].id, note="written")
    with Store.open(closed) as store:
        assert store.check().ok


def test_a_disk_that_fails_while_the_mode_is_set_makes_no_map(tmp_path, monkeypatch):
    """SQLite stays in the mode that it was in, and raises nothing."""
    monkeypatch.setattr(sqlite, "has_log", lambda file: False)
    with pytest.raises(DiskError):
        Store.create(tmp_path / "m")
    assert not list(tmp_path.iterdir())

"""Looking at the catalog's file does not cost the locks that SQLite has on it."""

import os
import threading

import pytest
from sqlalchemy import text
from store_children import add, messages

from gsmap.store import Store, file_handles, sqlite


def come_and_go(path, seed, pipe):
    """Another process: opens, adds a scene, tells what it sees, closes."""
    with Store.open(path) as store:
        add(store, seed)
        pipe.send([scene.name for scene in store.scenes.list()])


@pytest.mark.parametrize("look", ["note", "check"])
def test_what_is_committed_after_a_look_at_the_file_is_seen_by_all(tmp_path, start, look):
    path = tmp_path / "m"
    Store.create(path).close()
    with Store.open(path) as store:
        add(store, 1)
        if look == "note":
            with store.catalog.lock():
                sqlite.checkpoint(store.catalog.engine, path / sqlite.FILE, at_bytes=1)
        else:
            assert store.check().ok
        for seed in (2, 4):
            process, pipe = start(come_and_go, str(path), seed)
            process.join(60)
            assert messages(pipe) == [[f"scene{n}" for n in range(1, seed + 1)]]
            assert (path / f"{sqlite.FILE}-wal").exists()  # ours: nobody else deletes it
            add(store, seed + 1)
    with Store.open(path) as store:
        assert len(store.scenes.list()) == 5
        assert store.check().ok


def test_many_threads_share_a_store(store):
    """Twenty at once: each has a connection of its own, and nobody closes that of another."""
    for seed in range(3):
        add(store, seed)
    errors = []

    def look():
        try:
            for _ in range(20):
                assert len(store.scenes.list()) == 3
                with store.catalog.write() as connection:
                    connection.execute(text("UPDATE scenes SET source = source"))
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=look) for _ in range(20)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []


def test_nothing_of_a_file_stays_open_with_nobody_at_it(tmp_path):
    path = tmp_path / "m"
    Store.create(path).close()
    about = os.stat(path / sqlite.FILE)
    key = about.st_dev, about.st_ino
    with Store.open(path) as one, Store.open(path) as other:
        assert one.check().ok
        one.close()
        assert key in file_handles._OPEN
        assert other.check().ok
    assert key not in file_handles._OPEN
    assert not [name for name in os.listdir("/proc/self/fd") if _target(name).startswith(str(path))]


def _target(name):
    try:
        return os.readlink(f"/proc/self/fd/{name}")
    except FileNotFoundError:  # that of the listing itself
        return ""

"""Looking at the catalog's file does not cost the locks that SQLite has on it."""

import pytest
from store_children import add, messages

from gsmap.store import Store, sqlite


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

"""In what order bytes, names and rows reach the disk, and under which locks."""

import fcntl
import os
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import Connection, event
from store_samples import key, make_cameras, make_gaussians

from gsmap.store import Store, sqlite
from gsmap.store.arrays import Arrays
from gsmap.types import NodeLayer, SceneGraph


def is_locked(path: Path) -> bool:
    """Whether anybody holds a lock of this file or folder that keeps others from writing."""
    handle = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return False
    except BlockingIOError:
        return True
    finally:
        os.close(handle)


class Recorder:
    """Every fsync, rename and commit, in order, each with whether the map's writer lock was held."""

    def __init__(self, monkeypatch, store: Store) -> None:
        self.store = store
        self.events: list[tuple[str, Path, Path, bool]] = []
        fsync, rename, replace = os.fsync, os.rename, os.replace

        def note(kind: str, source: object = "", target: object = "") -> None:
            lock = store.folder / "lock"
            self.events.append((kind, Path(str(source)), Path(str(target)), lock.exists() and is_locked(lock)))

        def noted_fsync(handle: int) -> None:
            fsync(handle)
            note("fsync", os.readlink(f"/proc/self/fd/{handle}"))

        def noted_rename(source, target) -> None:
            rename(source, target)
            note("rename", source, target)

        def noted_replace(source, target) -> None:
            replace(source, target)
            note("rename", source, target)

        monkeypatch.setattr(os, "fsync", noted_fsync)
        monkeypatch.setattr(os, "rename", noted_rename)
        monkeypatch.setattr(os, "replace", noted_replace)

        def noted_commit(connection: Connection) -> None:
            if connection.get_execution_options().get("gsmap_write"):
                note("commit")

        event.listen(store.catalog.engine, "commit", noted_commit)

    def index(self, kind: str, path: Path | None = None, *, last: bool = False) -> int:
        """Where the only such event stands, or the last one; a rename goes by its target."""
        found = [
            i
            for i, (what, source, target, _) in enumerate(self.events)
            if what == kind and (path is None or path == (target if kind == "rename" else source))
        ]
        assert len(found) == 1 or (last and found), (kind, path, found)
        return found[-1]


def check_published(recorder: Recorder, place: Path) -> None:
    """A group's every file and folder was synchronised, then renamed, then its new name, and only then committed."""
    events = recorder.events
    renamed = recorder.index("rename", place)
    staged = events[renamed][1]
    parts = [place, *place.rglob("*")]
    assert len(parts) == 2
    before = {path for what, path, _, _ in events[:renamed] if what == "fsync"}
    missing = {part for part in parts if staged / part.relative_to(place) not in before}
    assert missing == set()
    named = recorder.index("fsync", place.parent)
    committed = next(i for i in range(renamed, len(events)) if events[i][0] == "commit")
    assert renamed < named < committed
    assert [locked for _, _, _, locked in events[renamed : committed + 1]] == [True] * (committed - renamed + 1)


@pytest.fixture
def recorder(store, monkeypatch):
    return Recorder(monkeypatch, store)


@pytest.mark.guards("data")
def test_a_scene_is_on_the_disk_before_its_row(store, recorder):
    scene, _ = store.scenes.add(make_gaussians(), make_cameras(), name="a")
    check_published(recorder, store.folder / "arrays" / "scenes" / scene.id)
    recorder.index("fsync", store.folder / "arrays")  # the new folder "scenes"
    assert not is_locked(store.folder / "lock")


@pytest.mark.guards("data")
def test_a_graph_is_on_the_disk_before_its_row(store, recorder):
    scene, _ = store.scenes.add(make_gaussians(), make_cameras(), name="a")
    recorder.events.clear()
    nodes = NodeLayer.empty("m")
    store.graphs.save(SceneGraph(scene.id, {"objects": nodes}), key("describe", scene.id))
    (place,) = (store.folder / "arrays" / "graphs").iterdir()
    check_published(recorder, place)


def test_a_model_is_on_the_disk_before_its_row(store, recorder, tmp_path):
    (tmp_path / "net.onnx").write_bytes(b"x")
    model = store.models.add("net", tmp_path / "net.onnx", kind="clip")
    renamed = recorder.index("rename", model.path)
    assert recorder.index("fsync", recorder.events[renamed][1]) < renamed
    assert renamed < recorder.index("fsync", model.path.parent) < recorder.index("commit")


@pytest.mark.guards("data")
def test_a_new_map_appears_whole(tmp_path, monkeypatch, store):
    recorder = Recorder(monkeypatch, store)
    Store.create(tmp_path / "new").close()
    renamed = recorder.index("rename", tmp_path / "new")
    staged = recorder.events[renamed][1]
    synced = [i for i, (what, path, *_) in enumerate(recorder.events) if (what, path) == ("fsync", staged)]
    assert recorder.index("rename", staged / "map.sqlite.digests", last=True) < max(synced) < renamed
    assert renamed < recorder.index("fsync", tmp_path)


def test_writing_holds_the_lock_and_reading_does_not(store):
    lock = store.folder / "lock"
    with store.catalog.write():
        assert is_locked(lock)
        with store.catalog.write():
            pass
        assert is_locked(lock)  # the inner one does not free it
    assert not is_locked(lock)
    with store.catalog.read():
        assert not is_locked(lock)
    with pytest.raises(RuntimeError), store.transaction():
        raise RuntimeError
    assert not is_locked(lock)


@pytest.mark.guards("data")
def test_the_log_is_folded_in_under_the_lock(store, monkeypatch):
    """In SQLite before 3.51.3 a commit at the same time could corrupt the file."""
    real, held = sqlite.checkpoint, []

    def checkpoint(*arguments, **more):
        held.append(is_locked(store.folder / "lock"))
        real(*arguments, **more)

    monkeypatch.setattr(sqlite, "checkpoint", checkpoint)
    store.scenes.add(make_gaussians(), make_cameras(), name="a")
    with Store.open(store.folder) as other:
        other.scenes.remove("a")
    assert held == [True, True, True]  # two transactions and a closing


@pytest.mark.guards("data")
def test_what_is_being_staged_is_not_swept_away(store):
    others = Arrays(store.arrays.root)
    with store.arrays.stage({"a": np.zeros(3)}, "scenes", "0" * 32) as staged:
        assert is_locked(store.arrays.staging)
        assert others.drop_leftovers() == 0
        assert staged.folder.is_dir()
        with others.stage({"a": np.zeros(3)}, "scenes", "1" * 32):  # two may stage at a time
            pass
        assert staged.folder.is_dir()
    assert not staged.folder.exists()  # nobody published it
    (store.arrays.staging / "leftover").mkdir()
    (store.arrays.staging / "leftover" / "c").write_bytes(b"123")
    assert others.drop_leftovers(dry_run=True) == 3
    assert others.drop_leftovers() == 3
    assert list(store.arrays.staging.iterdir()) == []

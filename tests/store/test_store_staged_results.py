"""Results whose arrays a worker stages: saved by a row, checked, and gone if either process is killed."""

from __future__ import annotations

import errno
import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import store_children
from raising import raises
from store_samples import key, made_prepared, make_cameras, make_gaussians

from gsmap.errors import InputError, StoreError
from gsmap.map.jobs import staged
from gsmap.store import Store
from gsmap.store.arrays import StagedGroup, StoredFile
from gsmap.types import NodeLayer, SceneGraph


@pytest.fixture
def scene(store: Store) -> str:
    return store.scenes.add(make_gaussians(300), make_cameras(), name="a")[0].id


def nodes(count: int) -> NodeLayer:
    return NodeLayer(
        positions=np.ones((count, 3)),
        embeddings=np.eye(count, 8, dtype=np.float32),
        types=np.zeros(count),
        weights=np.ones(count),
        extents=np.ones((count, 2, 3)),
        features=np.ones((count, 2)),
        num_views=np.zeros(count),
        descriptor_id="d",
    )


def left(store: Store) -> list[str]:
    return sorted(os.listdir(store.arrays.staging))


@pytest.mark.guards("data")
def test_a_worker_that_only_reads_the_map_stages_what_its_caller_saves(store: Store, scene: str) -> None:
    graph = SceneGraph(scene, {"objects": nodes(5)})
    with store.arrays.inbox() as inbox:
        with Store.open(store.location, "r") as worker:
            of_graph = worker.graphs.stage(graph, key("describe", scene), inbox)
            of_scene = worker.prepared_scenes.stage(made_prepared(scene), key("register", scene), inbox)
        assert store.graphs.find(key("describe", scene)) is None  # nothing counts before it is saved
        assert store.graphs.save(of_graph, key("describe", scene)) == 5
        assert store.prepared_scenes.save(of_scene, key("register", scene)) == 5
        with raises(InputError, code="key_input_mismatch"):
            store.graphs.save(of_graph, key("describe"))
    assert left(store) == []
    assert store.check().ok
    loaded = store.graphs.load(scene, key("describe", scene))
    np.testing.assert_array_equal(loaded.layers["objects"].embeddings, graph.layers["objects"].embeddings)
    prepared = store.prepared_scenes.load(scene, key("register", scene))
    np.testing.assert_array_equal(prepared.points, made_prepared(scene).points)
    before = store.arrays.groups()
    store.graphs.save(graph, key("describe", scene))  # staged by this process: the same group
    assert store.arrays.groups() == before


def test_what_is_not_saved_is_deleted(store: Store, scene: str) -> None:
    graph = SceneGraph(scene)
    with store.arrays.inbox() as inbox:
        found = store.graphs.stage(graph, key("describe", scene), inbox)
    assert left(store) == []
    assert {kind for kind, _ in store.arrays.groups()} == {"scenes"}
    with raises(StoreError, code="changed_meanwhile"):
        store.graphs.save(found, key("describe", scene))
    assert staged(store.graphs, graph, key("describe", scene), inbox) is graph  # too late
    assert left(store) == []


@pytest.mark.parametrize("fault", [errno.EACCES, errno.EROFS, errno.ENOSPC])
def test_where_a_worker_cannot_write_it_returns_the_result(
    store: Store, scene: str, fault: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = Path.mkdir

    def mkdir(path: Path, *arguments: object, **more: object) -> None:
        if path.parent.name == inbox:
            raise OSError(fault, os.strerror(fault), str(path))
        real(path, *arguments, **more)

    graph = SceneGraph(scene)
    with store.arrays.inbox() as inbox:
        monkeypatch.setattr(Path, "mkdir", mkdir)
        found = staged(store.graphs, graph, key("describe", scene), inbox)
        assert found is graph
        store.graphs.save(found, key("describe", scene))
    assert store.graphs.find(key("describe", scene)) is not None


@pytest.mark.guards("data")
def test_what_a_worker_claims_is_checked(store: Store, scene: str, tmp_path: Path) -> None:
    made, here = key("describe", scene), store.arrays.staging
    outside = tmp_path / "outside" / ("0" * 32)
    outside.mkdir(parents=True)
    (outside / "arrays.zip").write_bytes(b"123")
    with store.arrays.inbox() as inbox, Store.open(store.location) as other, other.arrays.inbox() as theirs:
        good = store.graphs.stage(SceneGraph(scene), made, inbox)
        (file,) = good.staged.files
        own = good.staged.folder.name
        (here / inbox / ("1" * 32)).symlink_to(outside)
        linked = here / inbox / ("2" * 32)
        linked.mkdir()
        (linked / "arrays.zip").symlink_to(outside / "arrays.zip")
        of_other = other.graphs.stage(SceneGraph(scene), made, theirs)
        small = (StoredFile("arrays.zip", 3, file.sha256),)
        claims = [
            StagedGroup(outside, small),
            StagedGroup(here / inbox / ".." / ".." / ".." / "outside" / ("0" * 32), small),
            StagedGroup(here / inbox / "..", good.staged.files),
            StagedGroup(here / inbox, good.staged.files),
            StagedGroup(Path(own), good.staged.files),
            StagedGroup(Path(), good.staged.files),
            StagedGroup(here / inbox / ("1" * 32), small),
            StagedGroup(linked, small),
            StagedGroup(here / inbox / ("3" * 32), good.staged.files),
            of_other.staged,
            replace(good.staged, files=()),
            replace(good.staged, files=(replace(file, path="../arrays.zip"),)),
            replace(good.staged, files=(replace(file, size_bytes=file.size_bytes - 1),)),
            replace(good.staged, files=(file, replace(file, path="more.zip"))),
        ]
        for claim in claims:
            with pytest.raises(StoreError) as caught:
                store.graphs.save(replace(good, staged=claim), made)
            assert caught.value.code in ("changed_meanwhile", "link_refused"), claim
            assert store.graphs.find(made) is None
        for bad in (replace(good, group_id="../../x"), replace(good, about={})):
            with pytest.raises((StoreError, InputError)):
                store.graphs.save(bad, made)
            assert store.graphs.find(made) is None
        good = store.graphs.stage(SceneGraph(scene), made, inbox)
        elsewhere = replace(good.staged, folder=Path("/mnt", inbox, good.staged.folder.name))
        store.graphs.save(replace(good, staged=elsewhere), made)  # the worker sees the map under another path
    assert store.graphs.find(made) is not None
    assert sorted(path.name for path in outside.iterdir()) == ["arrays.zip"]
    assert left(store) == []


@pytest.mark.guards("data")
def test_killed_at_every_change_nothing_counts_and_nothing_stays(store: Store, scene: str, start) -> None:
    for step in range(1, 200):
        process, pipe = start(store_children.stage_and_save, store.location, step)
        process.join()
        (told,) = store_children.messages(pipe)
        saved = store.graphs.find(key("describe", scene)) is not None
        assert saved == (store.prepared_scenes.load(scene, key("register", scene)) is not None)
        assert store.check().problems == ()
        assert saved or told != "through"
        store.prune()
        assert left(store) == []
        assert {kind for kind, _ in store.arrays.groups()} == {"scenes", *(["graphs", "prepared"] if saved else [])}
        if saved:
            break
    else:
        raise AssertionError("it never came through")


@pytest.mark.guards("data")
def test_a_killed_worker_and_a_killed_caller_leave_nothing(store: Store, scene: str, start) -> None:
    with store.arrays.inbox() as inbox:
        process, pipe = start(store_children.stage_for, store.location, scene, inbox)
        process.join()
        assert store_children.messages(pipe) == os.listdir(store.arrays.staging / inbox)
        assert store.prune().num_bytes == 0  # another process may save it yet
        assert len(os.listdir(store.arrays.staging / inbox)) == 1
    assert left(store) == []
    process, pipe = start(store_children.hold_inbox, store.location)
    inbox = pipe.recv()
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    assert left(store) == [inbox]
    assert store.check().ok
    assert store.prune().num_bytes > 0
    assert left(store) == []

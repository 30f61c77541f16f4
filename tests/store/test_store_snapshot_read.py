"""What is read inside one reading is of one moment, whatever others write meanwhile."""

import numpy as np
import pytest
from raising import raises
from store_samples import key, made_change, make_cameras, make_gaussians, save_comparison

from gsmap.errors import CorruptError, NotFoundError
from gsmap.map import reports
from gsmap.store import Store
from gsmap.types import SceneGraph


def add(store, seed):
    return store.scenes.add(make_gaussians(seed=seed), make_cameras(), name=f"scene{seed}")[0]


def see_one_state(store, other):
    add(store, 1)
    with store.catalog.read():
        assert [scene.name for scene in store.scenes.list()] == ["scene1"]
        add(other, 2)
        assert [scene.name for scene in store.scenes.list()] == ["scene1"]
    assert [scene.name for scene in store.scenes.list()] == ["scene1", "scene2"]


def test_on_sqlite(store):
    with Store.open(store.folder) as other:
        see_one_state(store, other)


def test_on_postgres(tmp_path, postgres_database):
    with (
        Store.create(tmp_path / "m", catalog_url=postgres_database) as store,
        Store.open(tmp_path / "m", catalog_url=postgres_database) as other,
    ):
        see_one_state(store, other)


@pytest.mark.parametrize("report", [reports.scene_rows, reports.edge_rows, reports.pose_rows, reports.revision_rows])
def test_reports_read_inside_one(store, report, monkeypatch):
    """The first thing that a report asks for is asked for inside a reading that lasts until its end."""
    add(store, 1)
    depth = []
    read = type(store.catalog).read

    def watched(catalog):
        depth.append(getattr(catalog._thread, "reading", None))
        return read(catalog)

    monkeypatch.setattr(type(store.catalog), "read", watched)
    report(store)
    assert depth[0] is None
    assert len(depth) > 1
    assert all(depth[1:])


@pytest.mark.parametrize("read", ["gaussians", "cameras"])
@pytest.mark.guards("data")
def test_arrays_that_are_pruned_while_they_are_read_are_not_called_damaged(store, monkeypatch, read):
    add(store, 1)
    prune_when_read(store, monkeypatch)
    with raises(NotFoundError, code="changed_meanwhile"):
        getattr(store.scenes, read)("scene1")


@pytest.mark.guards("data")
def test_a_graph_that_is_pruned_while_it_is_read_is_not_called_damaged(store, monkeypatch):
    scene = add(store, 1).id
    store.graphs.save(SceneGraph(scene), key("describe", scene))
    prune_when_read(store, monkeypatch)
    with raises(NotFoundError, code="changed_meanwhile"):
        store.graphs.load(scene)


@pytest.mark.guards("data")
def test_a_comparison_that_is_pruned_while_it_is_read_is_not_called_damaged(store, monkeypatch):
    older, newer = (add(store, seed).id for seed in (1, 2))
    kept = save_comparison(store, older, newer, made_change(np.array([[0.0, 0, 0], [1, 1, 1]])))
    prune_when_read(store, monkeypatch)
    with raises(NotFoundError, code="changed_meanwhile"):
        store.changes.load(kept.number)


def read_in_snapshot(store, monkeypatch, url=None):
    add(store, 1)
    prune_when_read(store, monkeypatch, url)
    with store.catalog.read():
        with raises(NotFoundError, code="changed_meanwhile"):
            store.scenes.gaussians("scene1")
        assert [scene.name for scene in store.scenes.list()] == ["scene1"], "still the snapshot"
    assert not store.scenes.list()


@pytest.mark.guards("data")
def test_arrays_that_are_pruned_during_a_snapshot_are_not_called_damaged_on_sqlite(store, monkeypatch):
    read_in_snapshot(store, monkeypatch)


@pytest.mark.guards("data")
def test_arrays_that_are_pruned_during_a_snapshot_are_not_called_damaged_on_postgres(
    tmp_path, postgres_database, monkeypatch
):
    with Store.create(tmp_path / "m", catalog_url=postgres_database) as store:
        read_in_snapshot(store, monkeypatch, postgres_database)


@pytest.mark.guards("data")
def test_damaged_arrays_are_called_damaged_in_a_snapshot(store):
    add(store, 1)
    for file in (store.folder / "arrays").rglob("arrays.zip"):
        file.unlink()
    with store.catalog.read(), raises(CorruptError, code="arrays_missing"):
        store.scenes.gaussians("scene1")


def prune_when_read(store, monkeypatch, url=None):
    real = store.arrays.read

    def after_a_prune(*args, **options):
        with Store.open(store.folder, catalog_url=url) as other:
            other.scenes.remove("scene1")
            other.prune()
        return real(*args, **options)

    monkeypatch.setattr(store.arrays, "read", after_a_prune)

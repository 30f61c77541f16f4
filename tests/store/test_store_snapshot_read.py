"""What is read inside one reading is of one moment, whatever others write meanwhile."""

import numpy as np
import pytest
from raising import raises
from store_samples import key, made_change, make_cameras, make_gaussians, save_comparison

from gsmap.errors import NotFoundError
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


def prune_when_read(store, monkeypatch):
    real = store.arrays.read

    def after_a_prune(*args, **options):
        with Store.open(store.folder) as other:
            other.scenes.remove("scene1")
            other.prune()
        return real(*args, **options)

    monkeypatch.setattr(store.arrays, "read", after_a_prune)

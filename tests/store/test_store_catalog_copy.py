"""A catalog copied into another database says the same, row by row."""

import threading

import numpy as np
import pytest
from raising import raises
from sqlalchemy import func, insert, select, text
from store_samples import (
    JPEG,
    keep_objects,
    kept_photo,
    key,
    made_change,
    made_prepared,
    make_cameras,
    make_gaussians,
    save_comparison,
)
from test_store_nouns import graph_of, layer, registration, tile

from gsmap.errors import StoreError
from gsmap.store import Store, schema
from gsmap.store.arrays import CHUNK_ROWS
from gsmap.store.catalog import now
from gsmap.store.catalog_copy import copy_catalog, copy_rows, empty_catalog, snapshot_read, tables
from gsmap.store.indexes import Lookup
from gsmap.types import Prior, SceneGraph, Sim3
from gsmap.types.localization import SceneFeatures
from gsmap.types.retrieval import Candidate, IndexArrays, IndexedScene
from gsmap.types.world import ControlPoint


def fill(store):
    """A row in every table."""
    a, _ = store.scenes.add(make_gaussians(CHUNK_ROWS + 5), make_cameras(), name="a", notes=("ä\n",))
    b, _ = store.scenes.add(make_gaussians(seed=2), make_cameras(), name="b")
    store.graphs.save(SceneGraph(a.id, {"objects": layer()}), key("describe", a.id))
    saved = store.registrations.save(registration(a.id, b.id), key("register"))
    store.registrations.adopt(saved.number)
    store.registrations.review("a", "b", "confirm", "ok")
    save_comparison(store, a.id, b.id, made_change([[0, 0, 0], [1, 1, 1]]))
    store.changes.review(1, "confirm", "ok")
    store.revisions.save(graph_of([a, b]))
    store.priors.set(Prior("a", Sim3.identity(), np.full(7, np.inf)))
    store.world.add([ControlPoint("G1", "EPSG:25832", np.array([691234.5, 5334567.125, 519.3]))])
    store.exports.add_tile(store.exports.begin("/tmp/out", revision=1), tile("a.ply", [a, b]))
    nodes = IndexArrays(np.zeros(1, np.int64), np.arange(2, dtype=np.int64), np.zeros((1, 58), np.uint8))
    store.indexes.save_segment("0" * 32, [IndexedScene(a.id, "1" * 32, True, False, 1.5)], nodes, ())
    store.indexes.save_lookups([Lookup(a.id, "0" * 32, (Candidate(b.id, 1.0, 2.0),))])
    cameras = make_cameras()
    starts = np.zeros(len(cameras) + 1, np.int64)
    shown, angles = np.zeros((0, 128), np.int8), np.zeros(0, np.uint8)
    views = SceneFeatures(a.id, cameras, starts, np.zeros((0, 3), np.float32), shown, angles)
    store.view_features.save(views, key("localize", a.id))
    store.prepared_scenes.save(made_prepared(a.id), key("register", a.id))
    store.photos.add(kept_photo(a.id), JPEG)
    keep_objects(store, {a.id: [[0, 0, 0], [1, 1, 1]]})
    store.objects.edit(1, name="sofa")
    with store.transaction(), store.catalog.read() as connection:
        blank = {"name": "m", "kind": "clip", "path": "/m.onnx", "copied": 0, "sha256": "0" * 64, "size_bytes": 2**40}
        connection.execute(insert(schema.models), blank | {"options": {"x": 0.1}, "created_at": now()})
        connection.execute(insert(schema.leases), {column.name: "x" for column in schema.leases.columns})
        connection.execute(insert(schema.set_aside), {column.name: "x" for column in schema.set_aside.columns})
        connection.execute(
            insert(schema.backups), {"target": "t", "snapshot": "s", "created_at": now(), "num_bytes": 1}
        )
        connection.execute(insert(schema.purges), {"scene": "0" * 32, "receipt": {}, "created_at": now()})


def rows_of(catalog):
    with snapshot_read(catalog) as connection:
        return {t.name: [tuple(r) for r in connection.execute(select(t).order_by(*t.primary_key))] for t in tables()}


def test_all_rows_of_all_tables_are_copied(store, tmp_path):
    fill(store)
    (tmp_path / "copy").mkdir()
    made = empty_catalog(tmp_path / "copy")
    counts = copy_catalog(store.catalog, made)
    before = rows_of(store.catalog)
    assert rows_of(made) == before
    assert counts == {name: len(rows) for name, rows in before.items()}
    assert min(counts.values()) > 0, counts  # a table that is not filled here is not tested
    with raises(StoreError, code="database_not_empty"):
        copy_catalog(store.catalog, made)
    made.close()


def test_what_stays_behind(store, tmp_path):
    fill(store)
    (tmp_path / "copy").mkdir()
    made = empty_catalog(tmp_path / "copy")
    copy_catalog(store.catalog, made, leave_out=("leases", "backups"))
    left = {name for name, rows in rows_of(made).items() if not rows}
    assert left == {"leases", "backups"}
    made.close()


def test_to_postgres_and_back(store, tmp_path, postgres_database):
    fill(store)
    before = rows_of(store.catalog)
    for name in ("there", "back"):
        (tmp_path / name).mkdir()
    there = empty_catalog(tmp_path / "there", postgres_database, "0" * 32)
    copy_catalog(store.catalog, there)
    assert rows_of(there) == before
    back = empty_catalog(tmp_path / "back")
    copy_catalog(there, back)
    assert rows_of(back) == before
    # Numbers go on after those that were copied.
    with there.write() as connection:
        for table in (schema.scene_facts, schema.priors, schema.exports):
            old = connection.execute(select(table).order_by(table.c.number.desc())).mappings().first()
            fresh = {k: v for k, v in old.items() if k != "number"}
            connection.execute(insert(table), fresh)
            top = connection.execute(select(func.max(table.c.number))).scalar_one()
            assert top == old["number"] + 1
    there.close()
    back.close()


@pytest.mark.parametrize("kind", ["sqlite", "postgres"])
def test_a_copy_is_one_state_while_others_write(kind, tmp_path, request):
    """Facts are added two at a time: no copy has an odd number of them, though they are read between two writes."""
    url = request.getfixturevalue("postgres_database") if kind == "postgres" else None
    with Store.create(tmp_path / "m", catalog_url=url) as store:
        scene, _ = store.scenes.add(make_gaussians(), make_cameras(), name="a")
        rows = [{"scene": scene.id, "kind": "note", "value": str(i), "author": "", "created_at": ""} for i in range(2)]

        def write():
            with store.catalog.write() as connection:
                connection.execute(insert(schema.scene_facts), rows)
                connection.execute(insert(schema.purges), {"scene": "0" * 32, "receipt": {}, "created_at": ""})

        (tmp_path / "copy").mkdir()
        made = empty_catalog(tmp_path / "copy")
        with snapshot_read(store.catalog) as reading, made.write() as writing:
            reading.execute(text("SELECT count(*) FROM about")).scalar()  # from here on it sees this state
            thread = threading.Thread(target=write)
            thread.start()
            thread.join()
            copy_rows(reading, writing)
        found = rows_of(made)
        assert [row[3] for row in found["scene_facts"] if row[2] == "note"] == []
        assert found["purges"] == []
        assert len(rows_of(store.catalog)["purges"]) == 1
        made.close()

"""The same store with its catalog in a real PostgreSQL server."""

import errno
import stat

import numpy as np
import pytest
import store_children
from raising import raises
from sqlalchemy import create_engine
from store_children import messages
from store_samples import key, make_cameras, make_gaussians
from test_store_nouns import graph_of, layer, registration, tile

import gsmap.map
from gsmap.errors import ConfigError, CorruptError, DiskFullError, StoreError
from gsmap.store import Store, migrate, schema, trust
from gsmap.store.layout import CHUNK_ROWS
from gsmap.types import Prior, SceneGraph, Sim3


def test_the_whole_store_on_postgres(tmp_path, postgres_database):
    with Store.create(tmp_path / "m", catalog_url=postgres_database) as store:
        made = store.id
    assert not (tmp_path / "m" / "map.sqlite").exists()
    with Store.open(tmp_path / "m") as store:
        assert store.id == made
        g = make_gaussians(3 * CHUNK_ROWS)
        a, is_new = store.scenes.add(g, make_cameras(), name="a")
        assert is_new
        assert not store.scenes.add(g, make_cameras(), name="again")[1]
        b, _ = store.scenes.add(make_gaussians(seed=2), make_cameras(), name="a")
        assert b.name == "a-2"
        box = np.array([[-5.0] * 3, [-4.0] * 3])
        inside = ((g.means >= box[0]) & (g.means <= box[1])).all(1).sum()
        assert inside <= len(store.scenes.gaussians("a", box)) < CHUNK_ROWS
        store.graphs.save(SceneGraph(a.id, {"objects": layer()}), key("describe", a.id))
        assert store.graphs.load("a").num_nodes == 7
        saved = store.registrations.save(registration(a.id, b.id), key("register"))
        assert store.registrations.adopt(saved.number).number == saved.number
        assert store.registrations.review("a", "a-2", "confirm").number == saved.number
        np.testing.assert_array_equal(
            store.registrations.current()[0].registration.information, np.diag(np.arange(1.0, 8)) / 3
        )
        assert store.registrations.get("a", "a-2").registration.overlap == 0.1 + 0.2  # all of a double
        assert store.revisions.save(graph_of([a, b])) == 1
        assert store.revisions.get().outcomes == graph_of([a, b]).outcomes
        assert store.revisions.list()[0].num_tentative == 1
        store.priors.set(Prior("a", Sim3.identity(), np.full(7, np.inf)))
        assert np.isinf(store.priors.list()[0].sigmas).all()
        export = store.exports.begin(tmp_path / "out", revision=1)
        store.exports.add_tile(export, tile("a.ply", [a, b]))
        assert store.exports.tiles(tmp_path / "out")[0].num_gaussians == 42
        store.scenes.remove("a-2")
        assert store.prune().scene_names == ()
        assert store.prune(keep_revisions=0).scene_names == ("a-2",)
        assert store.check().ok
        assert "PostgreSQL" in store.check().unverified[0]
    with raises(StoreError, code="database_not_empty"):
        Store.create(tmp_path / "other", catalog_url=postgres_database)
    assert not (tmp_path / "other").exists()


def test_migrated_tables_are_the_schema_on_postgres(tmp_path, postgres_database):
    from alembic.autogenerate import compare_metadata
    from alembic.runtime.migration import MigrationContext

    with Store.create(tmp_path / "m", catalog_url=postgres_database) as store, store.catalog.read() as connection:
        options = {"compare_type": True, "include_name": lambda name, kind, _: name != schema.CHUNK_BOXES}
        assert compare_metadata(MigrationContext.configure(connection, opts=options), schema.metadata) == []


def test_a_database_whose_texts_are_bytes_is_refused(tmp_path, postgres_url):
    admin = create_engine(postgres_url.format("postgres"), isolation_level="AUTOCOMMIT")
    with admin.connect() as connection:
        options = "TEMPLATE template0 ENCODING 'SQL_ASCII' LC_COLLATE 'C' LC_CTYPE 'C'"
        connection.exec_driver_sql(f"CREATE DATABASE ascii {options}")
    admin.dispose()
    with raises(ConfigError, code="unsupported_encoding"):
        Store.create(tmp_path / "m", catalog_url=postgres_url.format("ascii"))
    assert not (tmp_path / "m").exists()


def test_a_map_that_could_not_be_made_leaves_its_database_empty(tmp_path, postgres_database, monkeypatch):
    def fail(folder):
        raise OSError(errno.ENOSPC, "no space")

    with monkeypatch.context() as patched:
        patched.setattr("gsmap.store.store.sync_folder", fail)
        with raises(DiskFullError, code="disk_full"):
            Store.create(tmp_path / "m", catalog_url=postgres_database)
    assert not (tmp_path / "m").exists()
    with Store.create(tmp_path / "m", catalog_url=postgres_database) as store:
        assert store.check().ok


def test_two_maps_made_at_once_in_one_database(tmp_path, postgres_database, monkeypatch):
    """The first map stays, though the second found the database empty before."""
    first = Store.create(tmp_path / "first", catalog_url=postgres_database)
    with monkeypatch.context() as patched:
        version = migrate.version
        seen = iter([None])
        patched.setattr(migrate, "version", lambda *arguments: next(seen, version(*arguments)))
        with raises(StoreError, code="database_not_empty"):
            Store.create(tmp_path / "second", catalog_url=postgres_database)
    assert not (tmp_path / "second").exists()
    first.scenes.add(make_gaussians(), make_cameras(), name="a")
    first.close()
    with Store.open(tmp_path / "first") as store:
        assert [scene.name for scene in store.scenes.list()] == ["a"]


def test_the_password_stays_out_of_the_map(tmp_path, guarded_database, monkeypatch):
    monkeypatch.delenv("PGPASSWORD", raising=False)
    with Store.create(tmp_path / "m", catalog_url=guarded_database) as store:
        made = store.id
    assert not [p for p in (tmp_path / "m").rglob("*") if p.is_file() and b"secret" in p.read_bytes()]
    with raises(StoreError, code="password_refused") as caught:
        Store.open(tmp_path / "m")
    assert "\n" not in str(caught.value)
    with Store.open(tmp_path / "m", catalog_url=guarded_database) as store:
        assert store.id == made
    monkeypatch.setenv("PGPASSWORD", "secret")
    with Store.open(tmp_path / "m") as store:
        assert store.id == made


@pytest.mark.guards("security")
def test_a_remembered_server_is_connected_to_only_once_it_is_trusted(tmp_path, postgres_database, monkeypatch):
    folder = tmp_path / "m"
    with Store.create(folder, catalog_url=postgres_database) as store:
        made = store.id
    assert (folder / "catalog.url").read_text().splitlines()[1] == made
    assert stat.S_IMODE(trust.config_file().stat().st_mode) == 0o600
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "of_another_user"))
    with raises(StoreError, code="untrusted_catalog"):
        Store.open(folder)
    monkeypatch.setenv("GSMAP_CATALOG", postgres_database)
    with Store.open(folder) as store:
        assert store.id == made
    monkeypatch.delenv("GSMAP_CATALOG")
    assert not gsmap.map.catalog_of(folder).trusted
    assert gsmap.map.trust(folder).trusted
    with Store.open(folder) as store:
        assert store.id == made
    # Another server under the same map's id, and another map under the same URL, are not what was trusted.
    trust.write(folder, postgres_database.replace("gsmap@", "eve@"), made)
    with raises(StoreError, code="untrusted_catalog"):
        Store.open(folder)
    trust.write(folder, postgres_database, "0" * 32)
    trust.trust("0" * 32, postgres_database)
    with raises(CorruptError, code="wrong_catalog"):
        Store.open(folder)


def test_a_catalog_url_of_an_older_gsmap_is_trusted_by_asking_its_database(tmp_path, postgres_database):
    folder = tmp_path / "m"
    with Store.create(folder, catalog_url=postgres_database) as store:
        made = store.id
    (folder / "catalog.url").write_text(postgres_database + "\n")
    with raises(StoreError, code="untrusted_catalog"):
        Store.open(folder)
    gsmap.map.trust(folder)
    assert (folder / "catalog.url").read_text() == f"{postgres_database}\n{made}\n"
    Store.open(folder).close()


def test_a_server_that_is_not_there(tmp_path):
    pytest.importorskip("psycopg")
    with pytest.raises(StoreError):
        Store.create(tmp_path / "m", catalog_url=f"postgresql+psycopg://nobody@/none?host={tmp_path}")
    for url in ("nonsense", "nonsense://x"):
        with raises(ConfigError, code="invalid_catalog_url"):
            Store.create(tmp_path / "m", catalog_url=url)
    assert list(tmp_path.iterdir()) == []


def test_four_writers_on_postgres(tmp_path, postgres_database, start):
    path = tmp_path / "m"
    Store.create(path, catalog_url=postgres_database).close()
    writers = [start(store_children.write_some, str(path), i, 3) for i in range(4)]
    for process, pipe in writers:
        process.join(120)
        assert messages(pipe) == ["done"]
    with Store.open(path) as store:
        assert len(store.scenes.list()) == 4 * 3 + 3
        assert [r.number for r in store.revisions.list()] == list(range(1, 13))
        assert store.check().problems == ()

import shutil

import pytest
import store_older
from raising import raises

import gsmap.map
from gsmap.errors import SchemaVersionError
from gsmap.store import Store, migrate, schema, sqlite


@pytest.mark.guards("data")
def test_a_map_of_schema_0001(tmp_path):
    path = store_older.unpack(tmp_path)
    with raises(SchemaVersionError, code="map_too_old"):
        Store.open(path)
    assert Store.migrate(path) == ("0001", schema.HEAD)
    assert (path / "map.sqlite.0001.bak").is_file()
    with Store.open(path, "r") as store:
        store_older.check_all(store)
    with Store.open(path) as store:
        store_older.use(store)


@pytest.mark.guards("data")
def test_its_backup_is_the_older_map(tmp_path):
    path = store_older.unpack(tmp_path)
    Store.migrate(path)
    for end in ("", "-wal", "-shm", ".sha256"):
        (path / f"map.sqlite{end}").unlink(missing_ok=True)
    shutil.move(path / "map.sqlite.0001.bak", path / sqlite.FILE)
    Store.migrate(path)
    with Store.open(path) as store:
        store_older.check_all(store)


@pytest.mark.guards("data")
def test_down_and_up_again_loses_nothing_that_schema_0001_knew(tmp_path):
    path = store_older.unpack(tmp_path)
    Store.migrate(path)
    with Store.open(path) as store:
        migrate.upgrade(store.catalog, "0001")
        migrate.upgrade(store.catalog)
        store_older.check_all(store)
        store_older.use(store)


def test_a_map_of_schema_0001_on_postgres(tmp_path, postgres_database):
    path = store_older.unpack(tmp_path)
    older = sqlite.engine(path / sqlite.FILE, writable=True)
    with Store._connect(path, "w", postgres_database) as store:
        migrate.upgrade(store.catalog, "0001")
        with older.connect() as source, store.catalog.write() as target:
            store_older.copy_rows(source, target)
    older.dispose()
    (path / sqlite.FILE).unlink()
    (path / "catalog.url").write_text(postgres_database + "\n")
    gsmap.map.trust(path)  # the map's own word is not enough
    with raises(SchemaVersionError, code="map_too_old"):
        Store.open(path)
    assert Store.migrate(path) == ("0001", schema.HEAD)
    with Store.open(path) as store:
        store_older.check_all(store)
        migrate.upgrade(store.catalog, "0001")
        migrate.upgrade(store.catalog)
        store_older.check_all(store)
        store_older.use(store)

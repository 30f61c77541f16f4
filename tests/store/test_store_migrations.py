import sqlite3
from pathlib import Path

import next_schema
import pytest
from raising import raises
from store_samples import make_cameras, make_gaussians

import gsmap.map
from gsmap.errors import SchemaVersionError, StoreError
from gsmap.store import Store, branches, migrate, page_digests, schema, sqlite
from gsmap.store.catalog import Catalog


def scripts():
    from alembic.script import ScriptDirectory

    return ScriptDirectory.from_config(migrate.config())


def empty(folder) -> Catalog:
    folder.mkdir()
    (folder / "arrays").mkdir()
    sqlite.create_file(folder / sqlite.FILE)
    return Catalog(folder, sqlite.engine(folder / sqlite.FILE, writable=True), writable=True)


def ddl(catalog: Catalog) -> list[str]:
    with catalog.read() as connection:
        found = connection.exec_driver_sql("SELECT sql FROM sqlite_master WHERE sql IS NOT NULL ORDER BY name")
        return [row[0] for row in found if "alembic" not in row[0]]


def set_version(folder, version: str) -> None:
    connection = sqlite3.connect(folder / "map.sqlite")
    connection.execute("UPDATE alembic_version SET version_num = ?", (version,))
    connection.commit()
    connection.close()
    page_digests.write_digests(folder / "map.sqlite")


def test_one_head_and_the_code_knows_it():
    assert scripts().get_heads() == [schema.HEAD]
    numbers = [s.revision for s in scripts().walk_revisions()][::-1]
    assert numbers == [f"{int(schema.FIRST) + i:04d}" for i in range(len(numbers))]


def test_migrated_tables_are_the_schema(tmp_path):
    from alembic.autogenerate import compare_metadata
    from alembic.runtime.migration import MigrationContext

    catalog = empty(tmp_path / "m")
    migrate.upgrade(catalog)
    with catalog.read() as connection:
        options = {
            "compare_type": True,
            "include_name": lambda name, kind, _: not (kind == "table" and name.startswith(schema.CHUNK_BOXES)),
        }
        assert compare_metadata(MigrationContext.configure(connection, opts=options), schema.metadata) == []
        strict = connection.exec_driver_sql("PRAGMA table_list").all()
    assert {row[1] for row in strict if row[5]} == set(schema.metadata.tables)


def test_every_step_up_and_down_with_data(tmp_path):
    """Up one at a time, data in, down to nothing, and up again."""
    catalog = empty(tmp_path / "m")
    numbers = [s.revision for s in scripts().walk_revisions()][::-1]
    for number in numbers:
        migrate.upgrade(catalog, number)
        assert migrate.version(catalog.engine, catalog.folder) == number
    first = ddl(catalog)
    with Store(branches.MapLocation(catalog.folder, catalog.folder), catalog) as store:
        store.scenes.add(make_gaussians(), make_cameras(), name="a")
        for number in [*numbers[-2::-1], "base"]:
            migrate.upgrade(catalog, number)
        assert ddl(catalog) == []
        migrate.upgrade(catalog)
        assert ddl(catalog) == first
        store.scenes.add(make_gaussians(), make_cameras(), name="a")
        assert store.check().ok


def test_a_failed_migration_changes_nothing(tmp_path, monkeypatch):
    catalog = empty(tmp_path / "m")
    real = migrate._run

    def half(connection, revision):
        real(connection, revision)
        raise RuntimeError("power cut")

    monkeypatch.setattr(migrate, "_run", half)
    with pytest.raises(RuntimeError):
        migrate.upgrade(catalog)
    assert ddl(catalog) == []
    assert migrate.version(catalog.engine, catalog.folder) is None
    monkeypatch.undo()
    assert migrate.upgrade(catalog) == (None, schema.HEAD)


def test_migrating_a_current_map_does_nothing(tmp_path):
    Store.create(tmp_path / "m").close()
    before = (tmp_path / "m" / "map.sqlite").read_bytes()
    assert Store.migrate(tmp_path / "m") == (schema.HEAD, schema.HEAD)
    assert (tmp_path / "m" / "map.sqlite").read_bytes() == before


def test_a_newer_map_is_left_alone(tmp_path):
    Store.create(tmp_path / "m").close()
    set_version(tmp_path / "m", "9999")
    before = (tmp_path / "m" / "map.sqlite").read_bytes()
    with raises(SchemaVersionError, code="map_too_new"):
        Store.migrate(tmp_path / "m")
    assert (tmp_path / "m" / "map.sqlite").read_bytes() == before


def test_a_map_of_an_older_release_is_read_without_migrating_it(tmp_path, keep_schema):
    with Store.create(tmp_path / "m") as store:
        store.scenes.add(make_gaussians(), make_cameras(), name="a")
        store.branches.make("b")
    before = (tmp_path / "m" / "map.sqlite").read_bytes()
    older = schema.HEAD
    next_schema.install(tmp_path / "migrations")
    for place in (tmp_path / "m", f"{tmp_path / 'm'}@b"):
        with raises(SchemaVersionError, code="map_too_old"):
            Store.open(place)
        with Store.open(place, "r") as store:
            assert store.scenes.get("a").source.startswith("migrated ")
            assert len(store.scenes.gaussians("a")) == len(make_gaussians())
            assert store.check().ok
        with gsmap.map.open(place) as m:
            assert [row.name for row in m.scene_rows()] == ["a"]
            with raises(StoreError, code="not_writable", match="gsmap migrate"):
                m.edit("a", note="newer")
    assert (tmp_path / "m" / "map.sqlite").read_bytes() == before
    assert Store.migrate(tmp_path / "m") == (older, next_schema.NUMBER)
    assert (tmp_path / "m" / f"map.sqlite.{older}.bak").is_file()
    for place in (tmp_path / "m", f"{tmp_path / 'm'}@b"):
        with Store.open(place) as store:
            store.scenes.edit("a", note="newer")
            assert store.check().ok


def test_on_postgres_an_older_map_is_migrated_first(tmp_path, postgres_database, keep_schema):
    Store.create(tmp_path / "m", catalog_url=postgres_database).close()
    next_schema.install(tmp_path / "migrations")
    with raises(SchemaVersionError, code="map_too_old"):
        Store.open(tmp_path / "m", "r")
    Store.migrate(tmp_path / "m")
    Store.open(tmp_path / "m").close()


def test_a_map_of_a_version_that_was_never_released_is_refused(tmp_path):
    Store.create(tmp_path / "m").close()
    set_version(tmp_path / "m", "0012")
    for use in (Store.open, Store.migrate, gsmap.map.open):
        with raises(SchemaVersionError, code="map_not_released"):
            use(tmp_path / "m")


def test_the_storage_page_names_every_table_and_version():
    page = (Path(__file__).parents[2] / "docs" / "reference" / "storage.md").read_text()
    for name in [*schema.metadata.tables, schema.CHUNK_BOXES, *(s.revision for s in scripts().walk_revisions())]:
        assert f"`{name}`" in page, name

import sqlite3
from pathlib import Path

import pytest
from raising import raises
from store_samples import make_cameras, make_gaussians

from gsmap.errors import SchemaVersionError
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


def test_one_head_and_the_code_knows_it():
    assert scripts().get_heads() == [schema.HEAD]
    numbers = [s.revision for s in scripts().walk_revisions()][::-1]
    assert numbers == [f"{i + 1:04d}" for i in range(len(numbers))]


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
    connection = sqlite3.connect(tmp_path / "m" / "map.sqlite")
    connection.execute("UPDATE alembic_version SET version_num = '9999'")
    connection.commit()
    connection.close()
    page_digests.write_digests(tmp_path / "m" / "map.sqlite")
    before = (tmp_path / "m" / "map.sqlite").read_bytes()
    with raises(SchemaVersionError, code="map_too_new"):
        Store.migrate(tmp_path / "m")
    assert (tmp_path / "m" / "map.sqlite").read_bytes() == before


def test_the_storage_page_names_every_table_and_version():
    page = (Path(__file__).parents[2] / "docs" / "reference" / "storage.md").read_text()
    for name in [*schema.metadata.tables, schema.CHUNK_BOXES, *(s.revision for s in scripts().walk_revisions())]:
        assert f"`{name}`" in page, name

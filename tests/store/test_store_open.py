import os
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest
from raising import raises
from store_samples import make_cameras, make_gaussians

import gsmap.map
import gsmap.store.store as store_module
from gsmap.errors import BusyError, ConfigError, CorruptError, NotFoundError, SchemaVersionError, StoreError
from gsmap.store import Store, page_digests, schema


def test_create_and_open(tmp_path):
    with Store.create(tmp_path / "a.gsmap") as store:
        made = store.id
    with Store.open(tmp_path / "a.gsmap", "r") as store:
        assert store.id == made
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.gsmap"]


def test_create_refuses_what_is_there(tmp_path):
    Store.create(tmp_path / "a").close()
    with raises(StoreError, code="already_exists"):
        Store.create(tmp_path / "a")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").touch()
    with raises(StoreError, code="already_exists"):
        Store.create(tmp_path / "full")
    with raises(StoreError, code="not_a_folder"):
        Store.create(tmp_path / "full" / "x")
    with raises(NotFoundError, code="folder_not_found"):
        Store.create(tmp_path / "none" / "a")
    (tmp_path / "empty").mkdir()
    Store.create(tmp_path / "empty").close()


def test_a_map_made_by_another_process_meanwhile_is_opened(tmp_path, monkeypatch):
    make_catalog, made = store_module._make_catalog, []

    def another_first(staged, url, undo):
        make_catalog(staged, url, undo)
        if not made:
            made.append(True)
            Store.create(tmp_path / f"{len(list(tmp_path.glob('?.gsmap')))}.gsmap").close()

    monkeypatch.setattr(store_module, "_make_catalog", another_first)
    with raises(StoreError, code="already_exists"):
        Store.create(tmp_path / "0.gsmap")
    made.clear()
    with gsmap.map.open_or_create(tmp_path / "1.gsmap") as m:
        assert not m.scenes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["0.gsmap", "1.gsmap"]


@pytest.mark.parametrize("replaced", [False, True])
def test_a_map_that_is_moved_while_open_is_not_written(tmp_path, replaced):
    with Store.create(tmp_path / "a.gsmap") as store:
        scene, _ = store.scenes.add(make_gaussians(seed=1), make_cameras(), name="y")
        os.rename(tmp_path / "a.gsmap", tmp_path / "b.gsmap")
        with raises(StoreError, code="changed_meanwhile"):
            store.scenes.gaussians(scene.id)
        if replaced:
            Store.create(tmp_path / "a.gsmap").close()
        with raises(StoreError, code=("changed_meanwhile", "system_refused")):
            store.scenes.add(make_gaussians(), make_cameras(), name="x")
        with raises(StoreError, code="changed_meanwhile"):
            store.leases.try_hold("x", "y")
    assert (tmp_path / "a.gsmap").exists() is replaced
    with Store.open(tmp_path / "b.gsmap", "r") as store:
        assert [one.id for one in store.scenes.list()] == [scene.id]


def test_open_refuses_what_is_no_map(tmp_path):
    with raises(NotFoundError, code="map_not_found"):
        Store.open(tmp_path / "none")
    with raises(StoreError, code="not_a_map"):
        Store.open(tmp_path)
    (tmp_path / "file").touch()
    with raises(StoreError, code="not_a_map"):
        Store.open(tmp_path / "file")
    with raises(ConfigError, code="invalid_choice", match="mode .*'rw'"):
        Store.open(tmp_path, "rw")
    assert list(tmp_path.iterdir()) == [tmp_path / "file"]


def test_foreign_database(tmp_path):
    Store.create(tmp_path / "m").close()
    file = tmp_path / "m" / "map.sqlite"
    for content in (b"this is not a database" * 100, b""):
        file.write_bytes(content)
        with pytest.raises(CorruptError) as caught:
            Store.open(tmp_path / "m")
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("version", "code"), [("9999", "map_too_new"), ("0000", "map_not_released")])
def test_other_schema_is_refused(tmp_path, version, code):
    Store.create(tmp_path / "m").close()
    with sqlite3.connect(tmp_path / "m" / "map.sqlite") as connection:
        connection.execute("UPDATE alembic_version SET version_num = ?", (version,))
    connection.close()
    page_digests.write_digests(tmp_path / "m" / "map.sqlite")
    for mode in "rw":
        with raises(SchemaVersionError, code=code):
            Store.open(tmp_path / "m", mode)
    if version > schema.HEAD:
        with raises(SchemaVersionError, code="map_too_new"):
            Store.migrate(tmp_path / "m")


def test_reading_store_refuses_to_write(store, two_scenes):
    before = {p: p.read_bytes() for p in store.folder.rglob("*") if p.is_file() and "sqlite-" not in p.name}
    with Store.open(store.folder, "r") as reader:
        assert len(reader.scenes.list()) == 2
        for change in (
            lambda: reader.scenes.add(make_gaussians(seed=5), make_cameras(), name="x"),
            lambda: reader.scenes.remove("scene0"),
            lambda: reader.prune(),
        ):
            with raises(StoreError, code="not_writable"):
                change()
    assert {p: p.read_bytes() for p in store.folder.rglob("*") if p.is_file() and "sqlite-" not in p.name} == before


def test_read_only_disk(tmp_path):
    """A real read-only mount where we may make one."""
    disk = tmp_path / "disk"
    disk.mkdir()
    with Store.create(disk / "m") as store:
        store.scenes.add(make_gaussians(), make_cameras(), name="a")
    mounted = subprocess.run(["mount", "--bind", disk, disk], capture_output=True)
    if mounted.returncode:
        pytest.skip("needs the right to mount")
    try:
        if subprocess.run(["mount", "-o", "remount,ro,bind", disk], capture_output=True).returncode:
            pytest.skip("needs the right to mount read-only")
        with Store.open(disk / "m", "r") as store:
            assert len(store.scenes.gaussians("a")) == 500
            assert store.check().ok
            assert not (disk / "m" / "map.sqlite-wal").exists()
        with raises(StoreError, code="not_writable"):
            Store.open(disk / "m", "w")
        with raises(StoreError, code="read_only"):
            Store.create(disk / "other")
    finally:
        subprocess.run(["umount", disk], check=True)


def test_busy_after_patience(store):
    import threading

    other = Store.open(store.folder)
    other.catalog.patience_s = 0.1
    with store.transaction():
        with raises(BusyError, code="lock_busy"):
            other.scenes.add(make_gaussians(), make_cameras(), name="x")
        results = []
        thread = threading.Thread(target=lambda: results.append(len(other.scenes.list())))
        thread.start()
        thread.join()
        assert results == [0]  # readers never wait
    other.close()


def test_settings_of_a_connection(store):
    with store.catalog.read() as connection:
        names = ("journal_mode", "synchronous", "foreign_keys")
        pragma = {name: connection.exec_driver_sql(f"PRAGMA {name}").scalar() for name in names}
    assert pragma == {"journal_mode": "wal", "synchronous": 2, "foreign_keys": 1}


def test_log_is_folded_in(store, monkeypatch):
    from gsmap.store import sqlite

    monkeypatch.setattr(sqlite, "CHECKPOINT_BYTES", 100_000)
    for i in range(30):
        store.models.add(f"m{i}", __file__, kind="clip", copy=False, options={"x": "y" * 5000})
    assert Path(store.folder / "map.sqlite-wal").stat().st_size < 400_000
    assert len(store.models.list()) == 30


def test_import_of_the_package_stays_light():
    code = (
        "import sys, gsmap, gsmap.formats, gsmap.ingest\n"
        "print([m for m in ('zarr', 'sqlalchemy', 'pycolmap', 'scipy') if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.strip() == "[]"

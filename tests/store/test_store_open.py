import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest
from store_samples import make_cameras, make_gaussians

from gsmap.errors import BusyError, ConfigError, CorruptError, NotFoundError, SchemaVersionError, StoreError
from gsmap.store import Store, digests, schema


def test_create_and_open(tmp_path):
    with Store.create(tmp_path / "a.gsmap") as store:
        made = store.id
    with Store.open(tmp_path / "a.gsmap", "r") as store:
        assert store.id == made
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.gsmap"]


def test_create_refuses_what_is_there(tmp_path):
    Store.create(tmp_path / "a").close()
    with pytest.raises(StoreError, match="is a map already"):
        Store.create(tmp_path / "a")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").touch()
    with pytest.raises(StoreError, match="not empty"):
        Store.create(tmp_path / "full")
    with pytest.raises(StoreError, match="is a file"):
        Store.create(tmp_path / "full" / "x")
    with pytest.raises(NotFoundError, match="does not exist"):
        Store.create(tmp_path / "none" / "a")
    (tmp_path / "empty").mkdir()
    Store.create(tmp_path / "empty").close()


def test_open_refuses_what_is_no_map(tmp_path):
    with pytest.raises(NotFoundError, match="gsmap init"):
        Store.open(tmp_path / "none")
    with pytest.raises(StoreError, match="not a gsmap map"):
        Store.open(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(StoreError, match="is a file"):
        Store.open(tmp_path / "file")
    with pytest.raises(ConfigError, match="mode"):
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


@pytest.mark.parametrize(("version", "message"), [("9999", "newer gsmap.*upgrade"), ("0000", "gsmap migrate")])
def test_other_schema_is_refused(tmp_path, version, message):
    Store.create(tmp_path / "m").close()
    with sqlite3.connect(tmp_path / "m" / "map.sqlite") as connection:
        connection.execute("UPDATE alembic_version SET version_num = ?", (version,))
    connection.close()
    digests.note(tmp_path / "m" / "map.sqlite")
    for mode in "rw":
        with pytest.raises(SchemaVersionError, match=message):
            Store.open(tmp_path / "m", mode)
    if version > schema.HEAD:
        with pytest.raises(SchemaVersionError, match="upgrade"):
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
            with pytest.raises(StoreError, match="opened for reading"):
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
        with pytest.raises(StoreError, match="cannot be written"):
            Store.open(disk / "m", "w")
        with pytest.raises(StoreError, match="Read-only"):
            Store.create(disk / "other")
    finally:
        subprocess.run(["umount", disk], check=True)


def test_busy_after_patience(store):
    import threading

    other = Store.open(store.folder)
    other.catalog.patience_s = 0.1
    with store.transaction():
        with pytest.raises(BusyError, match="try again"):
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

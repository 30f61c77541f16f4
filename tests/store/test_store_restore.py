"""Restoring: which state, whole or not at all, and nothing that a backup says is taken on trust."""

import os
import shutil
import time

import next_schema
import pytest
from raising import raises
from sqlalchemy import create_engine, text
from store_backups import PASSING, files_of, fill, holdings, make_snapshot, put, tables_of
from store_samples import make_cameras, make_gaussians

from gsmap.errors import CorruptError, DiskError, NotFoundError, SchemaVersionError, StoreError
from gsmap.store import Store
from gsmap.store.backup import Backup, clone, restore, save
from gsmap.store.backup import restoring as restoring_module
from gsmap.store.backup.repository import object_name
from gsmap.store.storage import FolderStorage


@pytest.fixture
def place(tmp_path):
    return FolderStorage(tmp_path / "backup")


@pytest.fixture
def site(tmp_path):
    """A map that nobody has open."""
    with Store.create(tmp_path / "site.gsmap") as store:
        fill(store, tmp_path)
    return tmp_path / "site.gsmap"


def test_a_state_by_time_or_name(site, place, tmp_path):
    saved = []
    with Store.open(site) as store:
        for i in range(3):
            store.scenes.add(make_gaussians(20, seed=20 + i), make_cameras(), name=f"n{i}")
            saved.append((save(store, place).snapshot, len(store.scenes.list())))
            time.sleep(0.01)
    for i, (snapshot, count) in enumerate(saved):
        for j, wanted in enumerate(
            [{"snapshot": snapshot.snapshot}, {"snapshot": snapshot.snapshot[-16:][:9]}, {"at": snapshot.created_at}]
        ):
            restore(place, tmp_path / f"r{i}{j}", **wanted)
            with Store.open(tmp_path / f"r{i}{j}", "r") as store:
                assert len(store.scenes.list()) == count
    restore(place, tmp_path / "late", at="2999-01-01T00:00:00+00:00")
    with Store.open(tmp_path / "late", "r") as store:
        assert len(store.scenes.list()) == saved[-1][1]
    for wanted in (
        {"at": "2001-01-01T00:00:00+00:00"},
        {"snapshot": "nonsense"},
        {"snapshot": saved[0][0].snapshot[:15]},
    ):
        with raises(NotFoundError, code="snapshot_not_found"):
            restore(place, tmp_path / "r", **wanted)
    assert not (tmp_path / "r").exists()


def test_nothing_that_exists_is_overwritten(site, place, tmp_path):
    with Store.open(site) as store:
        save(store, place)
    before = holdings(site)
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    (tmp_path / "file").touch()
    for taken in (site, tmp_path / "link", tmp_path / "file"):
        with raises(StoreError, code="already_exists"):
            restore(place, taken)
    with raises(NotFoundError, code="folder_not_found"):
        restore(place, tmp_path / "no" / "such")
    (tmp_path / "empty").mkdir()
    restore(place, tmp_path / "empty")
    assert holdings(tmp_path / "empty") == before == holdings(site)


@pytest.mark.guards("security")
@pytest.mark.guards("data")
def test_all_of_a_restored_map_is_on_the_disk_before_it_gets_its_name(site, place, tmp_path, monkeypatch):
    with Store.open(site) as store:
        store.branches.make("what-if")
        save(store, place)
    synced, at_rename = {}, {}
    fsync, rename = os.fsync, os.rename

    def note_sync(handle):
        fsync(handle)
        about = os.fstat(handle)
        synced[about.st_ino] = about.st_mtime_ns

    def note_rename(source, target):
        if target == tmp_path / "back.gsmap":
            for path in [source, *source.rglob("*")]:
                about = path.stat()
                at_rename[path.relative_to(source).as_posix()] = synced.get(about.st_ino) == about.st_mtime_ns
        rename(source, target)

    monkeypatch.setattr(os, "fsync", note_sync)
    monkeypatch.setattr(os, "rename", note_rename)
    restore(place, tmp_path / "back.gsmap")
    assert {"map.sqlite", "settings.toml", "arrays", "branches/what-if/map.sqlite"} <= set(at_rename)
    assert [path for path, is_synced in at_rename.items() if not is_synced] == []


def test_nobody_is_at_work_on_a_restored_map(site, place, tmp_path):
    lease = "INSERT INTO leases VALUES ('map', 't', 'h', '1', 'update', '2026-01-01', '2999-01-01')"
    with Store.open(site) as store:
        with store.catalog.write() as connection:
            connection.execute(text(lease))
        save(store, place)
    restore(place, tmp_path / "r")
    with Store.open(tmp_path / "r", "r") as store, store.catalog.read() as connection:
        assert connection.execute(text("SELECT count(*) FROM leases")).scalar() == 0


@pytest.mark.parametrize("harm", ["flip", "cut", "grow", "lose", "link"])
@pytest.mark.guards("data")
def test_a_damaged_object_is_never_restored(site, place, tmp_path, harm):
    with Store.open(site) as store:
        save(store, place)
    backup = Backup.at(place)
    file = next(f for f in backup.files(backup.find()) if f.path.endswith("arrays.zip"))
    path = place.root / object_name(file.sha256)
    data = bytearray(path.read_bytes())
    if harm == "flip":
        data[-1] ^= 1
    elif harm == "cut":
        del data[-1]
    elif harm == "grow":
        data += b"x"
    path.unlink()
    if harm == "link":
        (tmp_path / "elsewhere").write_bytes(data)
        path.symlink_to(tmp_path / "elsewhere")
    elif harm != "lose":
        path.write_bytes(data)
    with raises(StoreError, code=("bytes_differ", "backup_damaged", "link_refused"), match=file.sha256):
        restore(place, tmp_path / "r")
    assert sorted(p.name for p in tmp_path.iterdir() if p.name.startswith((".", "r"))) == []


HOSTILE_PATHS = [
    "../evil",
    "/tmp/evil",
    "arrays/../../evil",
    "arrays/scenes/../../../evil",
    "arrays/staging/a/b",
    "arrays//scenes/a/b",
    "arrays/scenes/a",
    "arrays",
    "models/../evil",
    "models/a/b",
    "./map.sqlite",
    "map.sqlite/",
    "map.sqlite-wal",
    "catalog.url",
    "lock",
    "branches/../map.sqlite",
    "branches/a/arrays/scenes/b/c",
    "branches/a/b/map.sqlite",
    "settings.toml/x",
    "models/\x1b[2J",
    "models/a\\b",
    f"models/{'x' * 256}",
    "evil",
]


@pytest.mark.parametrize("path", HOSTILE_PATHS)
@pytest.mark.guards("security")
def test_a_path_outside_the_map_is_refused(site, place, tmp_path, path):
    with Store.open(site, "r") as store:
        map_id = store.id
    make_snapshot(place, map_id, {**files_of(site), path: b"evil"})
    before = sorted(str(p) for p in tmp_path.rglob("*"))
    with raises(CorruptError, code="invalid_stored_name") as caught:
        restore(place, tmp_path / "r")
    assert "\x1b" not in str(caught.value)
    assert sorted(str(p) for p in tmp_path.rglob("*")) == before


def test_lists_that_are_none(site, place, tmp_path):
    with Store.open(site, "r") as store:
        map_id = store.id
    files = files_of(site)
    make_snapshot(place, map_id, files, created_at="2026-01-01T03:04:05.000000+00:00")
    good = "".join(f"{put(place, data)} {len(data)} {path}\n" for path, data in files.items())
    twice = good + good.splitlines()[0] + "\n"
    short = good.replace(good[:64], good[:63])
    for i, lines in enumerate(
        (twice, short, good.upper(), good.replace(" ", "\t"), "\x00\xff", "map.sqlite\n", good + "x" * 300)
    ):
        make_snapshot(
            place, map_id, files, lines.encode("latin-1"), created_at=f"2026-01-02T03:04:{10 + i}.000000+00:00"
        )
        with pytest.raises(CorruptError):
            restore(place, tmp_path / "r")
    # a negative or absurd size, of the list or of a file
    make_snapshot(place, map_id, files, created_at="2026-02-02T03:04:05.000000+00:00", files_bytes=1 << 40)
    with pytest.raises(CorruptError):
        restore(place, tmp_path / "r")
    huge = good.replace(f" {len(files['map.sqlite'])} map.sqlite", f" {10**17} map.sqlite")
    make_snapshot(place, map_id, files, huge.encode(), created_at="2026-03-02T03:04:05.000000+00:00")
    with raises(StoreError, code="disk_full"):
        restore(place, tmp_path / "r")
    assert not (tmp_path / "r").exists()


@pytest.mark.guards("data")
def test_snapshots_that_say_what_is_not_so(site, place, tmp_path):
    with Store.open(site, "r") as store:
        map_id = store.id
    files = files_of(site)
    lacking = {path: data for path, data in files.items() if not path.endswith("arrays.zip")}
    other = {**files, "map.sqlite": b"no database"}
    for i, (content, changed) in enumerate(
        [
            (lacking, {}),
            ({"settings.toml": b""}, {}),
            (other, {}),
            (files, {"schema": "0002"}),
            (files, {"counts": {"a\x1b": 1}}),
            (files, {"files": "../../x"}),
            (files, {"map_id": "0" * 32}),
            (files, {"num_bytes": "many"}),
        ]
    ):
        changed = {"created_at": f"2026-01-02T03:04:{10 + i}.000000+00:00", **changed}
        make_snapshot(place, map_id, content, **changed)
        with raises(CorruptError, code="snapshot_lacks_file" if i < 2 else "backup_damaged"):
            restore(place, tmp_path / "r")
        assert not (tmp_path / "r").exists()
    name = Backup.at(place).names()[0]
    path = place.root / "snapshots" / f"{name}.json"
    path.write_bytes(path.read_bytes().replace(b'"revision": null', b'"revision": 1234'))
    with raises(CorruptError, code="backup_damaged"):
        restore(place, tmp_path / "r", snapshot=name)


def test_a_newer_format_is_refused(site, place, tmp_path):
    with Store.open(site) as store:
        save(store, place)
    marker = place.root / "gsmap-backup.json"
    marker.write_text(marker.read_text().replace('"format": 1', '"format": 2'))
    with raises(StoreError, code="backup_version"):
        restore(place, tmp_path / "r")
    marker.write_text("[]")
    with raises(CorruptError, code="backup_damaged"):
        restore(place, tmp_path / "r")


@pytest.mark.guards("security")
def test_links_in_a_backup_are_not_followed(site, place, tmp_path):
    with Store.open(site) as store:
        save(store, place)
        outside = tmp_path / "outside"
        shutil.move(place.root / "objects", outside)
        (place.root / "objects").symlink_to(outside)
        before = sorted(outside.rglob("*"))
        with raises(StoreError, code="link_refused"):
            save(store, place, keep=1)
        with raises(StoreError, code="link_refused"):
            restore(place, tmp_path / "r")
    assert sorted(outside.rglob("*")) == before


def test_an_older_schema_is_restored_and_asks_to_be_migrated(site, tmp_path, place, keep_schema):
    with Store.open(site) as store:
        save(store, place)
    next_schema.install(tmp_path / "migrations")
    assert restore(place, tmp_path / "r").catalog_schema < next_schema.NUMBER
    with raises(SchemaVersionError, code="map_too_old"):
        Store.open(tmp_path / "r")
    assert Store.migrate(tmp_path / "r")[1] == next_schema.NUMBER
    assert holdings(tmp_path / "r") == holdings(site)


def test_into_postgres(site, place, tmp_path, postgres_database):
    with Store.open(site) as store:
        save(store, place)
    restore(place, tmp_path / "r", catalog_url=postgres_database)
    assert not list((tmp_path / "r").glob("map.sqlite*"))
    assert holdings(tmp_path / "r") == holdings(site)
    with Store.open(tmp_path / "r") as store:
        store.scenes.add(make_gaussians(seed=9), make_cameras(), name="later")
        assert store.check().ok
    with raises(StoreError, code="database_not_empty"):
        restore(place, tmp_path / "r2", catalog_url=postgres_database)
    assert not (tmp_path / "r2").exists()


def test_an_older_schema_into_postgres(site, tmp_path, place, postgres_database, keep_schema):
    with Store.open(site) as store:
        save(store, place)
    next_schema.install(tmp_path / "migrations")
    restore(place, tmp_path / "r", catalog_url=postgres_database)
    assert holdings(tmp_path / "r") == holdings(site)
    with Store.open(tmp_path / "r") as store:
        assert {scene.source.split()[0] for scene in store.scenes.list()} == {"migrated"}


@pytest.mark.guards("data")
def test_a_database_is_empty_again_where_the_map_did_not_come_to_be(
    site, place, tmp_path, postgres_database, monkeypatch
):
    with Store.open(site) as store:
        save(store, place)

    def fail(folder, target):
        raise OSError(5, os.strerror(5))

    monkeypatch.setattr(restoring_module, "_put_in_place", fail)
    with raises(StoreError, code="disk_failed"):
        restore(place, tmp_path / "r", catalog_url=postgres_database)
    engine = create_engine(postgres_database)
    assert tables_of(engine) == []
    engine.dispose()
    monkeypatch.undo()
    restore(place, tmp_path / "r", catalog_url=postgres_database)
    assert holdings(tmp_path / "r") == holdings(site)


@pytest.mark.guards("data")
def test_a_clone_is_another_map(site, tmp_path):
    with Store.open(site) as store:
        before = holdings(site)
        made = clone(store, tmp_path / "c.gsmap")
        assert made.map_id != store.id
        assert [(b.target, b.snapshot) for b in store.backups.list()] == [
            (str(tmp_path / "c.gsmap"), f"clone {made.map_id}")
        ]
    after = holdings(tmp_path / "c.gsmap")
    left_behind = {"about", "exports", "tiles", "revisions", *PASSING}
    assert {k: v for k, v in after.items() if k not in left_behind} == {
        k: v for k, v in before.items() if k not in left_behind
    }
    assert after["exports"] == after["tiles"] == []
    with Store.open(tmp_path / "c.gsmap") as copy, Store.open(site) as store:
        assert copy.id == made.map_id
        assert copy.backups.list() == []
        arrays = [p for p in (tmp_path / "c.gsmap" / "arrays").rglob("*") if p.is_file()]
        assert made.num_linked >= len(arrays) > 0
        assert made.num_copied == 0
        assert all(p.stat().st_nlink == 2 for p in arrays)
        copy.scenes.remove("a")
        copy.prune(keep_revisions=0)
        copy.scenes.add(make_gaussians(seed=9), make_cameras(), name="later")
        assert copy.check().ok
        assert store.check().ok
        assert [scene.name for scene in store.scenes.list()] == ["a", "b"]
    assert holdings(site) == before
    with Store.open(site) as store, raises(StoreError, code="already_exists"):
        clone(store, tmp_path / "c.gsmap")


def test_a_clone_says_who_solved_its_poses(site, tmp_path):
    with Store.open(site) as store:
        clone(store, tmp_path / "c")
        map_id = store.id
    query = text("SELECT number, origin FROM revisions")
    with Store.open(tmp_path / "c") as copy, copy.catalog.read() as connection:
        assert [tuple(row) for row in connection.execute(query)] == [(1, f'{{"map":"{map_id}","number":1}}')]
        clone(copy, tmp_path / "cc")
    with Store.open(tmp_path / "cc") as copy, copy.catalog.read() as connection:
        assert [tuple(row) for row in connection.execute(query)] == [(1, f'{{"map":"{map_id}","number":1}}')]


def test_a_clone_on_a_disk_without_links(site, tmp_path, monkeypatch):
    def refuse(*arguments, **options):
        raise OSError(18, os.strerror(18))

    monkeypatch.setattr(os, "link", refuse)
    with Store.open(site) as store:
        made = clone(store, tmp_path / "c")
        assert (made.num_linked, made.num_copied > 0) == (0, True)
        broken = next((site / "arrays").rglob("scenes/*/arrays.zip"))
        data = bytearray(broken.read_bytes())
        data[-1] ^= 1
        broken.write_bytes(data)
        with raises(CorruptError, code="map_damaged"):
            clone(store, tmp_path / "c2")
    assert not (tmp_path / "c2").exists()
    with Store.open(tmp_path / "c") as store:
        assert store.check().ok


def test_a_clone_of_a_map_in_postgres(tmp_path, postgres_database):
    with Store.create(tmp_path / "m", catalog_url=postgres_database) as store:
        fill(store, tmp_path)
        clone(store, tmp_path / "c")
    with Store.open(tmp_path / "c") as store:
        assert (tmp_path / "c" / "map.sqlite").is_file()
        assert [scene.name for scene in store.scenes.list()] == ["a", "b"]
        assert store.check().ok


def test_a_disk_that_fails_when_all_is_in_place(site, place, tmp_path, monkeypatch):
    with Store.open(site) as store:
        save(store, place)
    whole = restoring_module.sync_folder

    def fail(folder):
        if folder == tmp_path:
            raise OSError(5, os.strerror(5))
        whole(folder)

    monkeypatch.setattr(restoring_module, "sync_folder", fail)
    with raises(DiskError, code="disk_failed"):
        restore(place, tmp_path / "r")
    assert holdings(tmp_path / "r") == holdings(site)

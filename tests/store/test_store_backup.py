"""A backup in a folder: what it saves, when it refuses, and what several at once do to each other."""

import fcntl
import hashlib
import json
import os
import shutil
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
from raising import raises
from store_backups import fill, holdings
from store_samples import make_cameras, make_gaussians

from gsmap.errors import ConfigError, CorruptError, DiskFullError, NotFoundError, StoreError
from gsmap.store import Store
from gsmap.store.backup import Backup, restore, save
from gsmap.store.backup import saving as saving_module
from gsmap.store.backup.backup_lease import EXPIRES_S, SAVE, SWEEP, BackupLease
from gsmap.store.backup.repository import object_name
from gsmap.store.backup.saving import sweep
from gsmap.store.catalog import Catalog
from gsmap.store.storage import FolderStorage, open_storage


@pytest.fixture
def place(tmp_path):
    return FolderStorage(tmp_path / "backup")


@pytest.fixture
def filled(store, tmp_path):
    fill(store, tmp_path)
    return store


def objects(place):
    return {path: path.stat().st_mtime_ns for path in (place.root / "objects").rglob("*") if path.is_file()}


def flip(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def restored(place, path):
    restore(place, path)
    return Store.open(path, "r")


def array_of(store, scene, name="arrays.zip"):
    return store.catalog.folder / "arrays" / "scenes" / store.scenes.get(scene).id / name


@pytest.mark.parametrize("kind", ["sqlite", "postgres"])
def test_a_restored_map_holds_what_was_saved(kind, tmp_path, place, request):
    url = request.getfixturevalue("postgres_database") if kind == "postgres" else None
    with Store.create(tmp_path / "m", catalog_url=url) as store:
        fill(store, tmp_path)
        map_id = store.id
    before = holdings(tmp_path / "m")
    with Store.open(tmp_path / "m") as store:
        made = save(store, place)
        assert [(b.target, b.snapshot) for b in store.backups.list()] == [(str(place.root), made.snapshot.snapshot)]
    assert made.snapshot.revision == 1
    assert made.snapshot.counts["scenes"] == 2
    restored = restore(place, tmp_path / "r")
    assert restored.snapshot == made.snapshot
    assert (tmp_path / "r" / "map.sqlite").is_file()  # also where the catalog was in PostgreSQL
    assert holdings(tmp_path / "r") == before
    with Store.open(tmp_path / "r") as store:
        assert store.id == map_id
        assert store.check().ok
        store.scenes.add(make_gaussians(seed=9), make_cameras(), name="later")
        assert store.check().ok


def test_only_what_is_new_is_sent(filled, place):
    save(filled, place)
    before = objects(place)
    again = save(filled, place)
    assert again.num_files_new == 2  # the catalog and the list of files
    assert {path: time for path, time in objects(place).items() if path in before} == before
    scene, _ = filled.scenes.add(make_gaussians(seed=5), make_cameras(), name="c")
    third = save(filled, place)
    num_arrays = sum(1 for p in array_of(filled, scene.id).parent.rglob("*") if p.is_file())
    assert 2 < third.num_files_new <= num_arrays + 2
    assert third.snapshot.num_bytes_new < third.snapshot.num_bytes


@pytest.mark.guards("data")
def test_a_damaged_map_is_not_backed_up(filled, place):
    broken = array_of(filled, "b")
    flip(broken)
    with raises(CorruptError, code="map_damaged") as caught:
        save(filled, place)
    assert str(broken) in str(caught.value)
    assert Backup.at(place).names() == []
    sizes = {p.name: p.stat().st_size for p in objects(place)}
    assert all(saving_module.hashlib.sha256(p.read_bytes()).hexdigest() == p.name for p in objects(place)), sizes
    filled.scenes.add(make_gaussians(300, seed=2), make_cameras(), name="b")  # mends it
    save(filled, place)
    for spoil in (lambda: flip(broken), broken.unlink):
        spoil()
        save(filled, place)  # it is in the backup already, which keeps the sound bytes
        assert not filled.check().ok
    with restored(place, place.root.with_name("r")) as whole:
        assert whole.check().ok
    array_of(filled, "a").unlink()
    shutil.rmtree(place.root)
    with raises(CorruptError, code="map_damaged"):
        save(filled, place)


def test_a_damaged_catalog_is_not_backed_up(tmp_path, place):
    """A text in it changes on the disk while the map is open, which SQLite itself would not notice."""
    with Store.create(tmp_path / "m") as store:
        fill(store, tmp_path)
    harm = "import sys; f = open(sys.argv[1], 'r+b'); d = f.read(); f.seek(d.rindex(b'settings') + 3); f.write(b'x')"
    with Store.open(tmp_path / "m", "r") as store:
        # by another process: to close the file in this one would drop the locks that SQLite has on it
        subprocess.run([sys.executable, "-c", harm, tmp_path / "m" / "map.sqlite"], check=True)
        with raises(CorruptError, code="map_damaged"):
            save(store, place)
    assert Backup.at(place).names() == []


class Meddling(FolderStorage):
    """A place at which something happens before an object is put."""

    def __init__(self, root, before):
        super().__init__(root)
        self.before = before
        self.puts = 0

    def put(self, name, chunks, size_bytes):
        if name.startswith("objects/"):
            self.puts += 1
            self.before(self.puts)
        super().put(name, chunks, size_bytes)


def test_scenes_that_are_pruned_meanwhile(filled, tmp_path, monkeypatch):
    whole, tries = saving_module.capture_state, []

    def capture(store, folder, **options):
        state = whole(store, folder, **options)
        if not tries:
            filled.scenes.remove("b")
            filled.prune(keep_revisions=0)
        tries.append(state)
        return state

    monkeypatch.setattr(saving_module, "capture_state", capture)
    made = save(filled, open_storage(tmp_path / "backup"))
    assert len(tries) == 2
    assert made.snapshot.counts["scenes"] == 1
    restore(open_storage(tmp_path / "backup"), tmp_path / "r")
    with Store.open(tmp_path / "r") as store:
        assert [scene.name for scene in store.scenes.list()] == ["a"]
        assert store.check().ok


def test_scenes_that_are_pruned_all_the_time(filled, tmp_path, monkeypatch):
    """Whatever is listed is gone before it is read: the last try holds the writers back."""
    tries, threads = [], []
    whole, send = saving_module.capture_state, saving_module._BackupRun._send

    def capture(store, folder, **options):
        state = whole(store, folder, **options)
        tries.append(state)

        def change():
            with Store.open(store.catalog.folder) as other:
                other.scenes.remove(f"n{len(tries) - 1}")
                other.prune()
                other.scenes.add(make_gaussians(50, seed=10 + len(tries)), make_cameras(), name=f"n{len(tries)}")

        threads.append(threading.Thread(target=change))
        threads[-1].start()
        return state

    def send_after_change(*arguments):
        threads[-1].join(2.0)  # the last one waits for the backup
        send(*arguments)

    filled.scenes.add(make_gaussians(50, seed=10), make_cameras(), name="n0")
    monkeypatch.setattr(saving_module, "capture_state", capture)
    monkeypatch.setattr(saving_module._BackupRun, "_send", send_after_change)
    save(filled, open_storage(tmp_path / "backup"))
    threads[-1].join()
    assert len(tries) == saving_module._TRIES + 1
    restore(open_storage(tmp_path / "backup"), tmp_path / "r")
    assert Store.open(tmp_path / "r").check().ok


@pytest.mark.parametrize("branch", ["", "@what-if"])
def test_the_last_try_waits_for_a_writer_who_waits_for_the_arrays(filled, tmp_path, monkeypatch, branch):
    """Pages that seem to differ are looked at again when nobody writes; who has arrays to publish must get on."""
    filled.branches.make("what-if")
    begun, errors = threading.Event(), []

    def write():
        try:
            with Store.open(f"{filled.location}{branch}") as other:
                other.catalog.patience_s = 5.0
                with other.catalog.write():
                    begun.set()
                    time.sleep(0.5)  # the backup has come to where it waits
                    with other.arrays.lock(5.0):
                        pass
        except Exception as error:
            errors.append(error)

    look = Catalog._compare_pages
    monkeypatch.setattr(saving_module, "_TRIES", 0)
    monkeypatch.setattr(
        Catalog, "_compare_pages", lambda c, *args: ["changing"] if is_locked(c.folder) else look(c, *args)
    )
    thread = threading.Thread(target=write)
    thread.start()
    assert begun.wait(5.0)
    began = time.monotonic()
    save(filled, open_storage(tmp_path / "backup"))
    thread.join()
    assert errors == []
    assert time.monotonic() - began < 4.0


def is_locked(folder):
    """Whether a writer is at work on the catalog there."""
    with open(folder / "lock", "rb") as handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        return False


def test_what_is_listed_is_not_asked_for_again(filled, tmp_path):
    class Counting(FolderStorage):
        asked = 0
        lagging = False

        def size_bytes(self, name):
            self.asked += 1
            return super().size_bytes(name)

        def list(self, prefix):
            found = super().list(prefix)
            if prefix == "objects/" and self.lagging:
                del found[object_name(hashlib.sha256(array_of(filled, "a").read_bytes()).hexdigest())]
            return found

    place = Counting(tmp_path / "backup")
    assert save(filled, place).num_files_new > 4
    assert place.asked == 0
    place.lagging = True  # what a listing lacks may be there all the same
    save(filled, place)
    assert place.asked == 1


def test_a_backup_that_is_interrupted_goes_on(filled, tmp_path):
    class Stop(Exception):
        pass

    def stop(count):
        if count > 5:
            raise Stop

    with pytest.raises(Stop):
        save(filled, Meddling(tmp_path / "backup", stop))
    place = open_storage(tmp_path / "backup")
    with raises(NotFoundError, code="snapshot_not_found"):
        restore(place, tmp_path / "r")
    sent = len(objects(place))
    assert sent > 0
    save(filled, place)
    restore(place, tmp_path / "r")
    assert holdings(tmp_path / "r") == holdings(filled.catalog.folder)
    assert list((place.root / "staging").iterdir()) == []
    assert list((place.root / "leases").iterdir()) == []


@pytest.mark.guards("data")
def test_verify_mends_what_the_map_has_and_tells_the_rest(filled, place, tmp_path):
    filled.scenes.add(make_gaussians(seed=7), make_cameras(), name="old")
    gone = array_of(filled, "old")
    lost = place.root / "objects" / (sha := saving_module.hashlib.sha256(gone.read_bytes()).hexdigest())[:2] / sha
    first = save(filled, place).snapshot
    filled.scenes.remove("old")
    filled.prune()
    here = saving_module.hashlib.sha256(array_of(filled, "a").read_bytes()).hexdigest()
    for path in (lost, place.root / "objects" / here[:2] / here):
        flip(path)
    with raises(CorruptError, code="bytes_differ", match=f"{here}|{sha}"):
        restore(place, tmp_path / "r", snapshot=first.snapshot)
    assert not (tmp_path / "r").exists()
    said = save(filled, place, verify=True)
    assert said.num_verified == len(objects(place)) - 2  # what it sent itself, it did not read again
    assert len(said.problems) == 1
    assert sha in said.problems[0]
    assert first.snapshot in said.problems[0]
    restore(place, tmp_path / "r")
    assert holdings(tmp_path / "r") == holdings(filled.catalog.folder)
    with raises(CorruptError, code="bytes_differ", match=sha):
        restore(place, tmp_path / "r2", snapshot=first.snapshot)
    lost.unlink()
    assert [sha in problem for problem in save(filled, place, verify=True).problems] == [True]


@pytest.mark.guards("data")
def test_keep_deletes_old_snapshots_and_what_only_they_needed(filled, place, tmp_path):
    filled.scenes.add(make_gaussians(seed=7), make_cameras(), name="old")
    old = saving_module.hashlib.sha256(array_of(filled, "old").read_bytes()).hexdigest()
    first = save(filled, place).snapshot
    second = save(filled, place).snapshot
    filled.scenes.remove("old")
    filled.prune()
    shutil.copy(place.root / "gsmap-backup.json", place.root / "objects" / "note.txt")  # not ours
    made = save(filled, place, keep=2)
    assert made.deleted == (first.snapshot,)
    assert Backup.at(place).names() == [second.snapshot, made.snapshot.snapshot]
    assert (place.root / "objects" / old[:2] / old).is_file()
    made = save(filled, place, keep=1)
    assert made.num_bytes_freed > 0
    assert Backup.at(place).names() == [made.snapshot.snapshot]
    assert not (place.root / "objects" / old[:2] / old).exists()
    assert (place.root / "objects" / "note.txt").is_file()
    kept = Backup.at(place).find()
    needed = {f.sha256 for f in Backup.at(place).files(kept)} | {kept.files}
    assert {p.name for p in objects(place)} - {"note.txt"} == needed
    restore(place, tmp_path / "r")
    assert holdings(tmp_path / "r") == holdings(filled.catalog.folder)
    with raises(ConfigError, code="out_of_range", match="snapshots .*0"):
        save(filled, place, keep=0)


def test_the_snapshot_just_made_stays_and_is_the_newest_though_a_clock_was_ahead(filled, place, tmp_path, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr("gsmap.store.catalog.now", lambda: "2190-01-01T00:00:00.000000+00:00")
        ahead = save(filled, place).snapshot
    filled.scenes.add(make_gaussians(seed=7), make_cameras(), name="new")
    second, third = save(filled, place), save(filled, place)
    assert any("clock" in note for note in second.notes)
    assert Backup.at(place).names() == [ahead.snapshot, second.snapshot.snapshot, third.snapshot.snapshot]
    last = save(filled, place, keep=1)
    assert Backup.at(place).names() == [last.snapshot.snapshot]
    restore(place, tmp_path / "r")
    assert holdings(tmp_path / "r") == holdings(filled.catalog.folder)


def test_a_snapshot_that_another_dates_later_meanwhile_does_not_end_the_one_just_made(filled, place, monkeypatch):
    made = save(filled, place).snapshot
    later = replace(Backup.at(place).find(), created_at="2190-01-01T00:00:00.000000+00:00")
    name, packed = later.packed()
    place.put(f"snapshots/{name}.json", [packed], len(packed))
    assert sweep(Backup.at(place), 1, made=made.snapshot)[0] == ()
    assert Backup.at(place).names() == [made.snapshot, name]


@pytest.mark.guards("data")
@pytest.mark.guards("data")
def test_every_snapshot_that_is_left_is_whole_wherever_a_sweep_ends(filled, place, tmp_path, monkeypatch):
    save(filled, place)
    filled.scenes.remove("a")
    filled.prune()
    filled.scenes.add(make_gaussians(20, seed=9), make_cameras(), name="new")
    save(filled, place)
    num_deleted = len(objects(place))
    for stop in range(num_deleted):
        there = FolderStorage(tmp_path / f"copy{stop}")
        shutil.copytree(place.root, there.root)
        left, delete = iter(range(stop)), there.delete

        def delete_some(name, left=left, delete=delete):
            if not name.startswith("leases/") and next(left, None) is None:
                raise KeyboardInterrupt
            delete(name)

        monkeypatch.setattr(there, "delete", delete_some)
        try:
            sweep(Backup.at(there), 1)
        except KeyboardInterrupt:
            pass
        else:
            break
        for snapshot in map(Backup.at(there).snapshot, Backup.at(there).names()):
            for file in Backup.at(there).files(snapshot):
                assert there.size_bytes(object_name(file.sha256)) == file.size_bytes
    assert stop > 2
    assert len(Backup.at(there).names()) == 1


def test_keep_deletes_nothing_when_a_snapshot_cannot_be_read(filled, place):
    save(filled, place)
    second = save(filled, place).snapshot
    flip(place.root / "snapshots" / f"{second.snapshot}.json")
    before = objects(place)
    with raises(CorruptError, code="backup_damaged"):
        save(filled, place, keep=2)
    assert before.items() <= objects(place).items()


def test_nothing_is_deleted_while_another_saves(filled, place):
    save(filled, place)
    with BackupLease(place, SAVE) as other:
        before = objects(place)
        made = save(filled, place, keep=1)
        assert made.deleted == ()
        assert "other processes use" in made.notes[0]
        assert before.keys() <= objects(place).keys()
        old = time.time() - EXPIRES_S - 60  # of one that died
        os.utime(place.root / other.name, (old, old))
        assert len(save(filled, place, keep=1).deleted) == 2


def test_a_backup_waits_for_who_deletes(filled, place):
    save(filled, place)
    done = []
    with BackupLease(place, SWEEP):
        thread = threading.Thread(target=lambda: done.append(save(filled, place)))
        thread.start()
        thread.join(0.5)
        assert thread.is_alive()
        assert len(Backup.at(place).names()) == 1
    thread.join(30)
    assert len(done) == 1


def test_one_whose_lease_was_taken_away_stops(filled, place):
    def take(count):
        if count == 3:
            for path in (place.root / "leases").iterdir():
                path.unlink()

    meddling = Meddling(place.root, take)
    save(filled, meddling)  # it is renewed; only who deletes must be sure of it
    with BackupLease(place, SWEEP) as lease:
        (place.root / lease.name).unlink()
        with raises(StoreError, code="lease_lost"):
            lease.others()
        lease._renewed -= EXPIRES_S
        with raises(StoreError, code="storage_failed"):
            lease.require()


@pytest.mark.parametrize("task", [SAVE, SWEEP])
def test_who_died_on_this_machine_is_not_waited_for(place, task):
    code = "import json; from dataclasses import asdict; from gsmap.types.lock_owner import this_process as me\n"
    code += "print(json.dumps(asdict(me('backup'))))"
    dead = json.loads(subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout)
    elsewhere = dead | {"process": " ".join([*dead["process"].split()[:2], "another-machine"])}
    leases = {}
    for told in (json.dumps(dead), json.dumps(elsewhere), "{}", "nonsense", json.dumps(dead) + " " * 20_000):
        name = f"leases/{task}-{len(leases):032x}.json"
        place.put(name, [told.encode()], len(told))
        leases[name] = told
    with BackupLease(place, SAVE) as lease:
        assert sorted(lease.others()) == sorted(leases)[1:]
    assert {f"leases/{path.name}" for path in (place.root / "leases").iterdir()} == set(sorted(leases)[1:])


def test_two_backups_at_once(filled, place, tmp_path):
    made, errors = [], []

    def run():
        try:
            with Store.open(filled.catalog.folder) as store:
                made.append(save(store, place, keep=5))
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=run) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    assert len(Backup.at(place).names()) == 3
    for i, one in enumerate(made):
        restore(place, tmp_path / f"r{i}", snapshot=one.snapshot.snapshot)
        assert holdings(tmp_path / f"r{i}") == holdings(filled.catalog.folder)


def test_places_that_are_refused(filled, place, tmp_path):
    for target in ("ftp://host/x", "s3://key:secret@bucket/x", "s3:///x", "file://host/x", "s3://bucket/x?secret=1"):
        with pytest.raises(ConfigError) as caught:
            open_storage(target)
        assert "secret" not in str(caught.value)
    assert open_storage(f"file://{tmp_path}/a%20b").root == tmp_path / "a b"
    with raises(ConfigError, code="backup_inside_map"):
        save(filled, FolderStorage(filled.catalog.folder / "backup"))
    with raises(StoreError, code="folder_not_empty"):
        save(filled, FolderStorage(tmp_path))
    save(filled, place)
    with Store.create(tmp_path / "other") as other, raises(StoreError, code="backup_of_another_map"):
        save(other, place)
    with raises(NotFoundError, code="not_a_backup"):
        restore(FolderStorage(tmp_path / "nowhere"), tmp_path / "r")


def test_a_map_that_cannot_be_written_is_backed_up(filled, place, tmp_path):
    filled.close()
    with Store.open(filled.catalog.folder, "r") as store:
        made = save(store, place)
    assert "no record of this backup" in made.notes[0]
    restore(place, tmp_path / "r")
    assert holdings(tmp_path / "r") == holdings(filled.catalog.folder)


def test_branches_and_tags_go_with_their_map(filled, place, tmp_path):
    filled.branches.make("what-if")
    filled.branches.make("v1", tag=True)
    home = filled.catalog.folder
    filled.scenes.remove("b")
    with Store.open(f"{home}@what-if") as branch:
        branch.scenes.add(make_gaussians(60, seed=8), make_cameras(), name="only-there")
        with raises(ConfigError, code="backup_of_branch"):
            save(branch, place)
    (home / "branches" / ".staged.1234").mkdir()
    (home / "branches" / ".staged.1234" / "branch.json").write_text("half written")
    save(filled, place)
    restore(place, tmp_path / "r")
    assert sorted(p.name for p in (tmp_path / "r" / "branches").iterdir()) == ["v1", "what-if"]
    for name, scenes in (("", ["a"]), ("@what-if", ["a", "b", "only-there"]), ("@v1", ["a", "b"])):
        assert holdings(tmp_path / f"r{name}") == holdings(Path(f"{home}{name}"))
        with Store.open(tmp_path / f"r{name}", "r") as store:
            assert sorted(scene.name for scene in store.scenes.list()) == scenes
            check = store.check()
            assert (check.ok, check.unverified) == (True, ())
    with raises(StoreError, code="not_writable"):
        Store.open(tmp_path / "r@v1")


def test_a_damaged_branch_is_named_and_left_out_and_nothing_older_goes(filled, place, tmp_path):
    filled.branches.make("good")
    filled.branches.make("bad")
    whole = save(filled, place).snapshot
    flip(filled.home / "branches" / "bad" / "map.sqlite")
    made = save(filled, place, keep=1)
    (problem,) = made.problems
    assert "branch bad" in problem
    assert made.deleted == ()
    assert Backup.at(place).names() == [whole.snapshot, made.snapshot.snapshot]
    restore(place, tmp_path / "now")
    restore(place, tmp_path / "before", snapshot=whole.snapshot)
    for folder, branches in ((tmp_path / "now", {"good"}), (tmp_path / "before", {"bad", "good"})):
        with Store.open(folder, "r") as store:
            assert {branch.name for branch in store.branches.list()} == branches
            assert store.check().ok
    filled.branches.delete("bad")
    assert save(filled, place, keep=1).deleted == (whole.snapshot, made.snapshot.snapshot)


def test_the_next_backup_removes_what_killed_ones_left(filled, place):
    save(filled, place)
    killed = subprocess.run(
        [sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True, check=True
    ).stdout.strip()
    lease = BackupLease(place, SAVE)
    _, _, machine = lease._holder.process.split(" ", 2)
    lease._holder = replace(lease._holder, process=f"{killed} 1 {machine}")
    lease._renew()
    (place.root / "staging" / "tmpdead").mkdir()
    (place.root / "staging" / "tmpdead" / "map.sqlite").write_bytes(b"x" * 1000)
    save(filled, place)
    assert list((place.root / "staging").iterdir()) == []
    assert place.list("leases/") == {}


def test_what_another_backup_is_staging_stays(filled, place):
    save(filled, place)
    with BackupLease(place, SAVE), place.staging() as folder:
        (folder / "map.sqlite").write_bytes(b"x")
        save(filled, place)
        assert (folder / "map.sqlite").exists()


def test_a_restored_map_and_the_map_itself_in_one_place_are_told(filled, place, tmp_path):
    first = save(filled, place)
    filled.scenes.edit("a", name="later")
    second = save(filled, place)
    restore(place, tmp_path / "newest")
    restore(place, tmp_path / "older", snapshot=first.snapshot.snapshot)
    with Store.open(tmp_path / "newest") as store:
        third = save(store, place)
        assert third.notes == ()
        assert {one.snapshot for one in store.backups.list()} >= {first.snapshot.snapshot, second.snapshot.snapshot}
    for store in (filled, Store.open(tmp_path / "older")):
        (note,) = save(store, place).notes
        assert "another copy of the map" in note
        store.close()


def test_no_message_holds_the_password_of_an_endpoint():
    from gsmap.store.storage import _first_line

    error = OSError("error sending request for url (http://me:pass@word@host:9000/b?x=1)\nhttp://me:pass@host")
    assert _first_line(error) == "error sending request for url (http://host:9000/b?x=1)"


def test_a_full_disk(filled, tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=100k", "none", disk], capture_output=True).returncode:
        pytest.skip("needs the right to mount a small file system")
    try:
        with raises(DiskFullError, code="disk_full"):
            save(filled, FolderStorage(disk / "backup"))
        assert not list((disk / "backup" / "snapshots").glob("*"))
        subprocess.run(["mount", "-o", "remount,size=20m", disk], check=True)
        save(filled, FolderStorage(disk / "backup"))
        used = sum(p.stat().st_blocks for p in disk.rglob("*")) // 2
        subprocess.run(["mount", "-o", f"remount,size={used + 60}k", disk], check=True)
        with raises(DiskFullError, code="disk_full"):
            restore(FolderStorage(disk / "backup"), disk / "r")
        assert sorted(p.name for p in disk.iterdir()) == ["backup"]
    finally:
        subprocess.run(["umount", disk], check=True)


def test_a_lease_that_a_sweeper_takes_for_a_leftover_is_written_again(place, monkeypatch):
    import os

    replace, swept = os.replace, []

    def swept_first(staged, target):
        if not swept:
            swept.append(staged)
            place.drop_leftovers()
        replace(staged, target)

    monkeypatch.setattr("gsmap.store.storage.os.replace", swept_first)
    place.put("leases/save-1.json", [b"{}"], 2)
    assert b"".join(place.get("leases/save-1.json")) == b"{}"
    assert swept

"""A map on a full disk is read, and prune makes room; nothing is called damaged."""

import os
import shutil
import subprocess

import pytest
from raising import raises
from store_samples import key, make_cameras, make_gaussians

from gsmap.cli import app
from gsmap.errors import DiskFullError
from gsmap.store import Store, sqlite
from gsmap.types import NodeLayer, PoseGraph, SceneGraph, ScenePose, Sim3


def make_map(path) -> None:
    """Two scenes, one of them removed, a graph, a revision, and what crashes leave."""
    with Store.create(path) as store:
        kept, _ = store.scenes.add(make_gaussians(600), make_cameras(), name="kept")
        store.scenes.add(make_gaussians(3000, seed=1, degree=2), make_cameras(), name="gone")
        store.graphs.save(SceneGraph(kept.id, {"objects": NodeLayer.empty("m")}), key("describe", kept.id))
        store.revisions.save(PoseGraph({kept.id: ScenePose(kept.id, Sim3.identity(), 0, "placed")}))
        store.scenes.remove("gone")


@pytest.fixture
def disk(tmp_path):
    """A small file system of its own."""
    place = tmp_path / "disk"
    place.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=6m", "none", place], capture_output=True).returncode:
        pytest.skip("needs the right to mount a small file system")
    yield place
    subprocess.run(["umount", "-l", place], check=True)


def fill(disk) -> None:
    """Take every last byte."""
    with open(disk / "filler", "ab", buffering=0) as filler:
        for size in (1 << 16, 1 << 12, 1):
            try:
                while True:
                    filler.write(b"x" * size)
            except OSError:
                pass
    assert os.statvfs(disk).f_bfree == 0


@pytest.fixture
def full(disk):
    make_map(disk / "m.gsmap")
    fill(disk)
    assert not (disk / "m.gsmap" / "map.sqlite-shm").exists()
    return disk / "m.gsmap"


@pytest.fixture
def run(capfd):
    def one(*arguments: object) -> tuple[int, str]:
        try:
            app.run(list(map(str, arguments)))
        except SystemExit as ended:
            code = ended.code or 0
        said = "".join(capfd.readouterr())
        assert "damaged" not in said
        assert "restore" not in said
        return code, said

    return one


@pytest.mark.parametrize("mode", ["r", "w"])
def test_a_full_map_is_read(full, mode):
    with Store.open(full, mode) as store:
        assert [s.name for s in store.scenes.list()] == ["kept"]
        assert len(store.scenes.gaussians("kept")) == 600
        assert len(store.revisions.get().poses) == 1
        report = store.check()
        assert (report.problems, report.orphans, report.unverified) == ((), (), ())
        assert store.prune(dry_run=True).scene_names == ("gone",)


def test_a_full_map_is_read_after_its_writer_was_killed(disk):
    """The log holds what was committed last, and there is no room for its index."""
    path = disk / "m.gsmap"
    make_map(path)
    store = Store.open(path)
    store.scenes.edit("kept", name="renamed")
    shutil.copytree(path, disk / "killed.gsmap", ignore=shutil.ignore_patterns("*-shm"))
    store.close()
    shutil.rmtree(path)
    fill(disk)
    with Store.open(disk / "killed.gsmap") as store:
        assert [s.name for s in store.scenes.list()] == ["renamed"]
        assert store.check().problems == ()
        with raises(DiskFullError, code="disk_full"):
            store.scenes.edit("renamed", name="again")
        store.prune()
    (disk / "filler").unlink()
    with Store.open(disk / "killed.gsmap") as store:
        store.scenes.edit("renamed", name="again")
    with Store.open(disk / "killed.gsmap", "r") as store:
        assert [s.name for s in store.scenes.list()] == ["again"]
        assert store.check().problems == ()


def test_writing_to_a_full_map_says_so_and_keeps_what_was(full):
    with Store.open(full) as store:
        for change in (
            lambda: store.scenes.add(make_gaussians(5), make_cameras(), name="x"),
            lambda: store.scenes.remove("kept"),
            lambda: store.exports.begin("/out", revision=1),
        ):
            with raises(DiskFullError, code="disk_full"):
                change()
        assert [s.name for s in store.scenes.list()] == ["kept"]
        assert store.check().problems == ()


def test_prune_makes_room_on_a_full_disk(full):
    """There is nothing here that no row names, so that bytes have to go before their rows."""
    with Store.open(full) as store:
        pruned = store.prune()
        assert pruned.scene_names == ("gone",)
        assert pruned.num_bytes > 100_000
        assert store.check().problems == ()
        assert store.check().orphans == ()
        store.scenes.edit("kept", name="renamed")
    with Store.open(full, "r") as store:
        assert store.scenes.list()[0].name == "renamed"
        assert store.check().problems == ()


def test_prune_that_cannot_make_room_does_not_advise_to_prune(disk, run):
    with Store.create(disk / "m.gsmap") as store:
        store.scenes.add(make_gaussians(600), make_cameras(), name="kept")
    fill(disk)
    code, said = run("prune", disk / "m.gsmap")
    assert (code, "the disk is full" in said, "free some space and try again" in said) == (1, True, True), said
    assert "gsmap prune" not in said
    code, said = run("edit", disk / "m.gsmap", "kept", "--name", "other")
    assert "gsmap prune may" in said


def test_prune_drops_what_no_row_names_first(disk, monkeypatch):
    from gsmap.store import integrity

    path = disk / "m.gsmap"
    make_map(path)
    scene = next((path / "arrays" / "scenes").iterdir())
    orphans = [("graphs", "0" * 32), ("scenes", "1" * 32)]
    for kind, name in orphans:
        shutil.copytree(scene, path / "arrays" / kind / name)
    (path / "arrays" / "staging" / "dead").mkdir(parents=True)
    (path / "arrays" / "staging" / "dead" / "c").write_bytes(b"x" * 5000)
    fill(disk)
    dropped = []
    real = integrity.Arrays.drop
    monkeypatch.setattr(integrity.Arrays, "drop", lambda self, *group: (dropped.append(group), real(self, *group)))
    with Store.open(path) as store:
        assert store.prune().num_orphans == 2
        assert sorted(dropped[:2]) == orphans
        assert len(dropped) == 3
        assert store.check().orphans == ()
        assert store.check().ok


def test_a_prune_that_was_killed_on_a_full_disk(full, monkeypatch):
    """What nothing claims is gone and its rows are there: no damage, and the content can come back."""
    from gsmap.store import integrity

    calls = []

    def refuse(catalog, waste):
        calls.append(waste)
        raise DiskFullError("still full") if len(calls) == 1 else KeyboardInterrupt

    with Store.open(full) as store:
        with monkeypatch.context() as patch:
            patch.setattr(integrity, "_drop_rows", refuse)
            with pytest.raises(KeyboardInterrupt):
                store.prune()
        assert len(calls) == 2
        assert store.check().problems == ()
        assert len(store.scenes.gaussians("kept")) == 600
    (full.parent / "filler").unlink()
    with Store.open(full) as store:
        assert store.scenes.add(make_gaussians(3000, seed=1, degree=2), make_cameras(), name="back")[1]
        assert len(store.scenes.gaussians("back")) == 3000
        store.scenes.remove("back")
        assert store.prune().scene_names == ("back",)
        assert store.check().ok


def test_the_verbs_on_a_full_disk(full, tmp_path, run):
    code, said = run("list", full, "scenes")
    assert (code, "kept" in said) == (0, True)
    assert run("show", full, "kept")[0] == 0
    assert run("check", full)[0] == 0
    code, said = run("export", full, tmp_path / "out", "--format", "ply", "--merge", "union")
    assert code == 0, said
    assert "does not know all" in said
    assert list((tmp_path / "out").rglob("*.ply"))
    code, said = run("edit", full, "kept", "--name", "other")
    assert (code, "the disk is full" in said) == (1, True)
    code, said = run("prune", full)
    assert (code, "freed" in said) == (0, True), said
    assert run("edit", full, "kept", "--name", "other")[0] == 0
    assert run("check", full)[0] == 0


def test_a_reader_without_room_keeps_writers_waiting_only_while_it_reads(full):
    reader = Store.open(full, "r")
    with reader.catalog.read() as connection:
        assert connection.exec_driver_sql("SELECT count(*) FROM scenes").scalar() == 2
        (full.parent / "filler").unlink()
        writer = Store.open(full)
        writer.catalog.patience_s = 0.1
        from gsmap.errors import BusyError

        with pytest.raises(BusyError):
            writer.scenes.edit("kept", name="other")
        assert connection.exec_driver_sql("SELECT name FROM scenes WHERE number = 1").scalar() == "kept"
    writer.scenes.edit("kept", name="other")
    assert reader.scenes.list()[0].name == "other"
    writer.close()
    reader.close()
    assert not (full / f"{sqlite.FILE}-wal").exists() or not (full / f"{sqlite.FILE}-wal").stat().st_size

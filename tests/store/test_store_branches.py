"""Branches and tags: other catalogs over the same arrays."""

import contextlib
import os
import re
import shutil
import threading
from pathlib import Path

import next_schema
import pytest
from raising import raises
from store_samples import key, make_cameras, make_gaussians

from gsmap.errors import ConfigError, NotFoundError, StoreError
from gsmap.store import Store, purging, schema
from gsmap.store.branches import locate
from gsmap.types import PoseGraph, SceneGraph, ScenePose, Sim3


def add(store, seed, name=None):
    return store.scenes.add(make_gaussians(50, seed=seed), make_cameras(), name=name or f"scene{seed}")[0].id


def at(store, name):
    return f"{store.home}@{name}"


def bytes_of(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def revise(store):
    return store.revisions.save(
        PoseGraph({s.id: ScenePose(s.id, Sim3.identity(), 0, "placed") for s in store.scenes.list()})
    )


def test_only_an_existing_map_has_branches(store, tmp_path):
    """Everything else is a path: of a map that is made, say, in a folder with an @."""
    for path in (tmp_path / "me@home.gsmap", tmp_path / "site@2.gsmap", f"{store.home}@a/b"):
        found = locate(path)
        assert (found.home, found.folder, found.branch) == (Path(path), Path(path), "")
    (tmp_path / "site@2.gsmap").mkdir()
    assert locate(tmp_path / "site@2.gsmap").folder == tmp_path / "site@2.gsmap"
    with pytest.raises(NotFoundError):
        locate(at(store, "none"))


def test_a_branch_changes_nothing_of_the_map_and_copies_no_array(store):
    first = add(store, 0)
    revise(store)
    (store.folder / "settings.toml").write_text("[optimize]\n")
    arrays = bytes_of(store.home / "arrays")
    made = store.branches.make("what-if")
    assert (made.name, made.kind, made.num_scenes, made.revision) == ("what-if", "branch", 1, 1)
    assert bytes_of(store.home / "arrays") == arrays
    with Store.open(at(store, "what-if")) as branch:
        assert (branch.home, branch.folder) == (store.home, store.home / "branches" / "what-if")
        assert branch.location == at(store, "what-if")
        assert branch.id != store.id
        assert (branch.folder / "settings.toml").read_text() == "[optimize]\n"
        branch.scenes.edit("scene0", name="renamed")
        second = add(branch, 1)
        revise(branch)
        branch.scenes.remove(first)
        assert branch.check().ok
    assert [s.name for s in store.scenes.list()] == ["scene0"]
    assert store.revisions.newest_number() == 1
    assert (store.home / "arrays" / "scenes" / second).is_dir()  # new arrays are shared, too
    assert store.check().ok
    assert not store.check().orphans


def test_the_revisions_of_a_branch_say_which_map_solved_them(store):
    add(store, 0)
    revise(store)
    store.branches.make("b")
    with Store.open(at(store, "b")) as branch:
        revise(branch)
        assert [r.origin for r in branch.revisions.list()] == [{"map": store.id, "number": 1}, None]
    assert [r.origin for r in store.revisions.list()] == [None]


def test_a_tag_cannot_be_written(store):
    add(store, 0)
    store.branches.make("v1", tag=True)
    add(store, 1)
    before = bytes_of(store.home / "branches" / "v1")
    with raises(StoreError, code="not_writable"):
        Store.open(at(store, "v1"))
    with Store.open(at(store, "v1"), "r") as tag:
        assert [s.name for s in tag.scenes.list()] == ["scene0"]
        with raises(StoreError, code="not_writable"):
            tag.scenes.edit("scene0", name="x")
        tag.branches.make("of-v1")
    with Store.open(at(store, "of-v1")) as branch:
        branch.scenes.edit("scene0", name="x")
    after = bytes_of(store.home / "branches" / "v1")
    beside = ("-shm", "-wal")  # readers leave them
    states = [{k: v for k, v in files.items() if not k.endswith(beside)} for files in (before, after)]
    assert states[0] == states[1]


def test_a_path_that_exists_wins(store, tmp_path):
    store.branches.make("b")
    shutil.copytree(store.home, tmp_path / "other@b")
    with Store.open(tmp_path / "other@b", "r") as other:
        assert other.home == other.folder == tmp_path / "other@b"
    (tmp_path / "site.gsmap@c").mkdir()
    with raises(ConfigError, code="branch_exists"):
        store.branches.make("c")


def test_names_become_paths(store, tmp_path):
    for bad in ("", ".", "..", ".x", "a/b", "../x", "a b", "a\n", "ä", "x" * 65, "-" * 65):
        with raises(ConfigError, code="invalid_name"):
            store.branches.make(bad)
    store.branches.make("x" * 64)
    store.branches.make("good")
    with raises(ConfigError, code="branch_exists"):
        store.branches.make("good", tag=True)
    with raises(NotFoundError, code="branch_not_found"):
        Store.open(at(store, "bad"))
    with raises(NotFoundError, code="branch_not_found"):
        Store.create(at(store, "bad"))
    with raises(StoreError, code="already_exists"):
        Store.create(at(store, "good"))
    with pytest.raises(ConfigError):
        Store.open(f"{store.home}@b d")
    with raises(NotFoundError, code="map_not_found"):
        Store.open(tmp_path / "nothing@good")


def test_links_are_no_branches(store, tmp_path):
    store.branches.make("b")
    shutil.move(store.home / "branches" / "b", tmp_path / "elsewhere")
    os.symlink(tmp_path / "elsewhere", store.home / "branches" / "b")
    assert store.branches.list() == []
    with pytest.raises(NotFoundError):
        Store.open(at(store, "b"))


@pytest.mark.guards("data")
def test_prune_keeps_what_any_branch_names(store):
    kept, gone = add(store, 0), add(store, 1)
    store.graphs.save(SceneGraph(kept), key("describe", kept))
    store.branches.make("b")
    store.branches.make("v1", tag=True)
    with Store.open(at(store, "b")) as branch:
        own = add(branch, 2)
        branch.scenes.remove(gone)
        branch.prune()
        for scene in (kept, gone):
            store.scenes.remove(scene)
        planned = store.prune(dry_run=True)
        assert planned.num_bytes == store.prune().num_bytes == 0
        assert planned.num_orphans == 0
        assert len(branch.scenes.gaussians(kept)) == 50
        assert branch.check().ok
    with Store.open(at(store, "v1"), "r") as tag:
        assert tag.check().ok
        assert len(tag.scenes.gaussians(gone)) == 50
    folder = store.home / "arrays" / "scenes"
    assert {p.name for p in folder.iterdir()} == {kept, gone, own}
    store.branches.delete("v1")
    assert store.prune().num_orphans == 1
    assert {p.name for p in folder.iterdir()} == {kept, own}
    store.branches.delete("b")
    assert store.prune().num_orphans == 3  # and the graph
    assert list(folder.iterdir()) == []
    assert store.branches.list() == []
    assert list((store.home / "branches").iterdir()) == []


def test_models_are_kept_for_branches(store, tmp_path):
    (tmp_path / "m.onnx").write_bytes(b"model")
    store.models.add("clip", tmp_path / "m.onnx", kind="clip")
    store.branches.make("b")
    store.models.remove("clip")
    assert store.prune().num_models == 0
    with Store.open(at(store, "b")) as branch:
        assert branch.models.get("clip").path.read_bytes() == b"model"
        branch.models.remove("clip")
        assert branch.prune().num_models == 1


def test_prune_refuses_while_a_branch_cannot_be_read(store):
    scene = add(store, 0)
    store.branches.make("b")
    store.scenes.remove(scene)
    (store.home / "branches" / "b" / "map.sqlite").write_bytes(b"rubbish" * 1000)
    with pytest.raises(StoreError):
        store.prune()
    assert (store.home / "arrays" / "scenes" / scene).is_dir()
    assert store.scenes.list(removed=True)
    assert any(problem.startswith("b: ") for problem in store.check().problems)
    assert [b.name for b in store.branches.list()] == ["b"]
    store.branches.delete("b")
    assert store.prune().scene_names == ("scene0",)


def flips(path, text):
    """A file's bytes with one bit of each place flipped at which it has a text; and of its middle."""
    whole = path.read_bytes()
    places = [len(whole) // 2, *(found.start() + 5 for found in re.finditer(re.escape(text), whole))]
    for place in places:
        yield whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :]


def test_nothing_that_a_branch_needs_is_reclaimed_whatever_became_of_its_files(store, tmp_path):
    """Each file of a branch flipped or missing, and its folder under other names."""
    store.branches.make("b")
    with Store.open(at(store, "b")) as branch:
        own = add(branch, 0)
    folder, arrays = store.home / "branches" / "b", store.home / "arrays" / "scenes" / own
    shutil.copytree(folder, tmp_path / "sound")
    names = sorted(path.name for path in folder.iterdir() if path.name != "lock")
    assert {"map.sqlite", "map.sqlite.digests", "branch.json"} <= set(names)

    def reclaimed(what):
        """Prune and purge as a person does who knows nothing of it, then put the branch back."""
        for attempt in (store.prune, store.reclaim, lambda: store.prune(dry_run=True)):
            with contextlib.suppress(StoreError):
                attempt()
        assert arrays.is_dir(), what
        shutil.rmtree(store.home / "branches")
        shutil.copytree(tmp_path / "sound", folder)

    for name in names:
        (folder / name).unlink()
        reclaimed(f"without {name}")
        for changed in list(flips(folder / name, own.encode())):
            (folder / name).write_bytes(changed)
            reclaimed(f"{name} with another bit")
    for other in (".b", "b.old", ".b.rescue", "b~", ".b.0123456"):
        folder.rename(folder.with_name(other))
        assert other == "b.old" or not store.check().ok
        reclaimed(f"called {other}")
    folder.rename(store.home / "branches" / "b~")
    with raises(StoreError, code="stray_branch"):
        store.prune()
    with raises(StoreError, code="stray_branch"):
        purging.begin(store, add(store, 1))
    assert store.scenes.get("scene1")
    (store.home / "branches" / "b~").rename(folder)
    assert store.check().ok
    assert store.prune().num_orphans == 0


def test_check_of_the_map_reads_what_only_branches_name(store):
    store.branches.make("b")
    with Store.open(at(store, "b")) as branch:
        scene = add(branch, 0)
    victim = next(p for p in (store.home / "arrays" / "scenes" / scene).rglob("*.zip") if p.is_file())
    victim.write_bytes(victim.read_bytes()[:-1])
    (problem,) = store.check().problems
    assert problem.startswith("b: ")


def test_the_same_content_in_two_branches_is_one_group(store, monkeypatch):
    store.branches.make("b")
    scene = add(store, 0)
    place = store.home / "arrays" / "scenes" / scene
    inode = place.stat().st_ino
    from gsmap.store import array_archive

    monkeypatch.setattr(array_archive, "_ZSTD_LEVEL", 9)  # another version would write other bytes
    with Store.open(at(store, "b")) as branch:
        assert add(branch, 0) == scene
        assert place.stat().st_ino == inode
        assert branch.check().ok
        victim = next(p for p in place.rglob("*.zip") if p.is_file())
        victim.write_bytes(b"")
        add(branch, 0)  # mended
        assert branch.check().ok
        assert len(branch.scenes.gaussians(scene)) == 50
    add(store, 0)
    assert store.check().ok


def test_nothing_is_reclaimed_between_a_rename_and_its_commit(store, monkeypatch):
    """A branch that has put a group in its place, and not yet committed, against a prune of the map."""
    store.branches.make("b")
    published, pruned = threading.Event(), threading.Event()
    from gsmap.store import array_groups

    name = array_groups.name

    def slow(*arguments):
        published.set()
        pruned.wait(1.0)  # longer than a prune takes
        name(*arguments)

    monkeypatch.setattr(array_groups, "name", slow)

    def ingest():
        with Store.open(at(store, "b")) as branch:
            add(branch, 0)

    worker = threading.Thread(target=ingest)
    worker.start()
    published.wait()
    reclaimed = store.prune()
    pruned.set()
    worker.join()
    assert reclaimed.num_orphans == 0
    with Store.open(at(store, "b"), "r") as branch:
        assert branch.check().ok


def test_making_a_branch_waits_for_a_prune(store, monkeypatch):
    """What a prune reclaims is not named by a branch that is made meanwhile."""
    scene = add(store, 0)
    store.scenes.remove(scene)
    from gsmap.store import sqlite

    begun, done = threading.Event(), threading.Event()
    backup = sqlite.backup

    def slow(*arguments):
        backup(*arguments)
        begun.set()
        done.wait(1.0)

    monkeypatch.setattr(sqlite, "backup", slow)
    worker = threading.Thread(target=lambda: Store.open(store.home).branches.make("b"))
    worker.start()
    begun.wait()
    store.prune()
    done.set()
    worker.join()
    with Store.open(at(store, "b"), "r") as branch:
        assert branch.check().ok
        assert len(branch.scenes.gaussians(scene)) == 50  # it knows it still, though removed


def test_a_branch_appears_whole_or_not_at_all(store, monkeypatch):
    add(store, 0)
    rename = os.rename

    def fails(source, target):
        if "branches" in str(target):
            raise OSError(5, "Input/output error")
        rename(source, target)

    monkeypatch.setattr(os, "rename", fails)
    with pytest.raises(StoreError):
        store.branches.make("b")
    monkeypatch.undo()
    assert list((store.home / "branches").iterdir()) == []
    leftover = store.home / "branches" / ".b.01234567"
    leftover.mkdir()
    (leftover / "map.sqlite").touch()
    assert store.branches.list() == []
    store.branches.make("b")
    store.prune()
    assert not leftover.exists()
    assert [b.name for b in store.branches.list()] == ["b"]


def test_migrating_a_map_migrates_its_branches(store, tmp_path, keep_schema):
    store.branches.make("b")
    store.branches.make("v1", tag=True)
    older = schema.HEAD
    next_schema.install(tmp_path / "migrations")
    assert Store.migrate(store.home) == (older, next_schema.NUMBER)
    for location in (store.location, at(store, "b"), at(store, "v1")):
        Store.open(location, "r").close()

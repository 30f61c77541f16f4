"""Forgetting a scene: no byte of the map tells of it afterwards, whatever happened on the way."""

import errno
import json
import os
import shutil
import sqlite3
import sys
from dataclasses import replace

import numpy as np
import pytest
from raising import raises
from sqlalchemy import event
from store_children import changes_disk
from store_samples import key, make_cameras, make_gaussians

import gsmap
from gsmap.errors import BusyError, DiskError, DiskFullError, NotFoundError
from gsmap.map.stages import purge
from gsmap.store import Store, purging
from gsmap.store.merging import merge
from gsmap.types import EdgeOutcome, PoseGraph, Prior, Provenance, Registration, SceneGraph, ScenePose, Sim3
from gsmap.types.world import Georeference, PositionFix, Residual

NAME, NOTE, SOURCE = "secret-garden", "the key is under the mat", "/home/ann/private/garden.ply"


def make(path):
    """A map of three scenes; the second is to be forgotten. Returns its id."""
    with Store.create(path) as store:
        ids = [
            store.scenes.add(
                make_gaussians(80, seed=i), make_cameras(), name=name, source=source, captured_at="2024-05-31"
            )[0].id
            for i, (name, source) in enumerate((("hall", "/a.ply"), (NAME, SOURCE), ("attic", "/c.ply")))
        ]
        secret = ids[1]
        for scene in ids:
            store.graphs.save(SceneGraph(scene), key("describe", scene))
        pose = Sim3(np.eye(3), np.array([1.0, 0, 0]))
        for a, b in ((0, 1), (1, 2), (0, 2)):
            done = Registration(ids[a], ids[b], "accepted", S_target_source=pose, information=np.eye(7), proposer="g")
            store.registrations.save(done, key("register", ids[a], ids[b]))
        store.registrations.review(ids[0], secret, "confirm", f"{NOTE} indeed")
        store.scenes.edit(secret, note=NOTE, tags_add=["mine-only"], author="ann")
        store.scenes.edit(secret, name=f"{NAME}-2")
        store.scenes.edit(secret, name=NAME)
        store.priors.set(Prior(secret, Sim3.identity(), np.full(7, 0.1)))
        store.world.add([PositionFix("f.jpg", secret, np.zeros(3), "EPSG:4979", np.array([11.0, 48, 500]), (1.0, 1.0))])
        left_out = Residual("fix", "f.jpg", secret, "outlier", (1.0, 0.0, 0.0), (1.0, 1.0, 1.0), reason=f"{NAME} lies")
        outcomes = {
            (ids[0], secret): EdgeOutcome("used", 1.0),
            (ids[0], ids[2]): EdgeOutcome("unused", 9.0, f"{secret} contradicts"),
        }
        placed = {s: ScenePose(s, Sim3.identity(), 0, "placed") for s in ids}
        told = Provenance(contradicted_priors=(secret, ids[0]))
        graph = PoseGraph(placed, outcomes, provenance=told, notes=(f"{NAME} lies far out", "all is well"))
        graph = replace(graph, world=(Georeference(0, residuals=(left_out,), problem=f"{NAME} is alone"),))
        store.revisions.save(graph)
        store.revisions.save(graph)
    return secret


def finds(folder, *texts):
    """Files below a folder that have one of the texts in their bytes or in their names."""
    return sorted(
        f"{text}: {p}"
        for text in texts
        for p in folder.rglob("*")
        if text in p.name or (p.is_file() and text.encode() in p.read_bytes())
    )


def kept_rows(folder):
    """Rows of the catalog with the id in them: the receipt alone."""
    connection = sqlite3.connect(folder / "map.sqlite")
    tables = [row[0] for row in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
    found = {t: list(connection.execute(f"SELECT * FROM {t}")) for t in tables}
    connection.close()
    return found


@pytest.fixture
def place(tmp_path):
    return tmp_path / "site.gsmap"


def test_nothing_of_it_is_left(place):
    secret = make(place)
    shutil.copy(place / "map.sqlite", place / "map.sqlite.0002.bak")  # what a migration left
    assert finds(place, NAME, NOTE, SOURCE, secret)
    with gsmap.map.open(place) as m:
        # Some builds of SQLite overwrite what they delete by themselves.
        event.listen(m.store.catalog.engine, "begin", lambda c: c.exec_driver_sql("PRAGMA secure_delete = OFF"))
        report = m.purge(NAME)
        assert [s.name for s in m.scenes()] == ["hall", "attic"]
        assert m.check().ok
    assert finds(place, NAME, NOTE, SOURCE, "mine-only") == []
    assert not (place / "map.sqlite.0002.bak").exists()
    assert {f.split("/")[-1] for f in finds(place, secret)} <= {"map.sqlite"}
    rows = kept_rows(place)
    assert [t for t, lines in rows.items() if any(secret in str(v) for line in lines for v in line)] == ["purges"]
    (receipt,) = rows["purges"]
    assert NAME not in str(receipt)
    assert report.scene_id == secret
    assert report.num_rows == {
        **{"scenes": 1, "graphs": 1, "registrations": 2, "reviews": 1, "poses": 1, "edges": 1, "priors": 1},
        **{
            "facts": 6,
            "leases": 0,
            "tiles": 0,
            "revisions": 2,
            "comparisons": 0,
            "changes": 0,
            "change_reviews": 0,
            "photos": 0,
            "object_places": 0,
            "object_facts": 0,
        },
        "set_aside": 0,
        "observations": 1,
    }
    assert report.num_groups == 2
    assert report.num_bytes > 1000
    assert report.catalog_copies == ("map.sqlite.0002.bak",)
    with Store.open(place, "r") as store:
        assert len(store.registrations.current()) == 1
        graph = store.revisions.get(1)
        assert len(graph.poses) == 2
        assert graph.notes == (
            "a scene that was purged lies far out",
            "all is well",
            "the pose of a scene that was purged is no longer part of this revision",
        )
        assert len(graph.provenance.contradicted_priors) == 1
        assert next(iter(graph.outcomes.values())).reason == "a scene that was purged contradicts"


def test_a_removed_scene_can_be_forgotten_and_comes_back_only_by_ingest(place, tmp_path):
    secret = make(place)
    shutil.copytree(place, tmp_path / "copy.gsmap")
    with gsmap.map.open(place) as m:
        m.remove(NAME)
        m.purge(NAME)
        assert finds(place, NAME, NOTE) == []
        with Store.open(tmp_path / "copy.gsmap", "r") as copy:
            merged = merge(m.store, copy)
            assert merged.num_scenes == 0
            assert any("was purged from this map" in note for note in merged.notes)
            with raises(NotFoundError, code="scene_removed"):
                m.restore_scene(secret, tmp_path / "copy.gsmap")
        assert finds(place, NAME, NOTE) == []
        assert m.check().ok
        again = m.store.scenes.add(make_gaussians(80, seed=1), make_cameras(), name="anew")[0]
        assert again.id == secret
        assert m.check().ok
        with pytest.raises(NotFoundError):
            m.purge("nobody")


def test_twice_shows_the_receipt(place):
    secret = make(place)
    with gsmap.map.open(place) as m:
        first = m.purge(NAME)
        assert m.purge(secret) == first
        with pytest.raises(NotFoundError):
            m.purge(NAME)  # nobody knows that name any more


def test_branches_are_told_of_and_purged_on_demand(place):
    secret = make(place)
    with gsmap.map.open(place) as m:
        m.branch("b")
        m.tag("v1")
        report = m.purge(NAME)
        assert report.branches == (f"{place}@b", f"{place}@v1")
        assert report.num_groups == 0  # the arrays are theirs now
        assert (place / "arrays" / "scenes" / secret).is_dir()
        report = m.purge(secret, branches=True)
        assert set(report.maps) == {f"{place}@b", f"{place}@v1"}
        assert report.num_groups == 2
        assert m.check().ok
    assert finds(place, NAME, NOTE, SOURCE) == []
    assert not (place / "arrays" / "scenes" / secret).exists()
    with gsmap.map.open(f"{place}@v1") as tag:
        assert [s.name for s in tag.scenes()] == ["hall", "attic"]


def test_all_at_once(place):
    make(place)
    with gsmap.map.open(place) as m:
        m.branch("b")
        report = m.purge(NAME, branches=True)
        assert report.maps == (str(place), f"{place}@b")
        assert report.branches == ()
    assert finds(place, NAME, NOTE, SOURCE) == []


def test_what_people_wrote_of_others_is_told_of(place):
    make(place)
    with gsmap.map.open(place) as m:
        m.edit("hall", note=f"west of {NAME}")
        m.store.backups.add("s3://bucket/site", "20240531", 10)
        shutil.copytree(place, place.with_name("linked"), copy_function=os.link)
        report = m.purge(NAME)
        assert [text.split()[:4] for text in report.mentions] == [["a", "note", "of", "scene"]]
        assert report.backups == ("s3://bucket/site 20240531",)
        assert report.linked_files >= 1
        assert m.show_scene("hall").name == "hall"


def test_tiles_made_with_it_go(place, tmp_path):
    make(place)
    out, gone, foreign = (tmp_path / n for n in ("out", "gone", "foreign"))
    with gsmap.map.open(place) as m:
        for target in (out, gone):
            m.export(target, format="ply", tile_size_m=0, merge="union")
        m.export(foreign, format="ply", tile_size_m=0, merge="union")
        shutil.rmtree(gone)
        text = json.loads((foreign / "tiles.json").read_text())
        (foreign / "tiles.json").write_text(json.dumps({**text, "map_id": "0" * 32}))
        kept = sorted(foreign.rglob("*"))
        before = list(out.rglob("*.ply"))
        assert before
        (out / ".partial").mkdir()
        (out / ".partial" / "x.ply").write_bytes(b"half a tile")
        report = m.purge(NAME)
        assert report.num_tiles == len(before)
        assert report.exports == (str(out),)
        assert {text.split(":")[0] for text in report.unreachable} >= {str(gone), str(foreign)}
        assert list(out.rglob("*.ply")) == []
        assert not (out / ".partial").exists()
        assert json.loads((out / "tiles.json").read_text())["tiles"] == []
        assert sorted(foreign.rglob("*")) == kept
        assert finds(out, NAME, report.scene_id) == []
        m.export(out, format="ply", tile_size_m=0, merge="union")
        assert len(list(out.rglob("*.ply"))) == 1


@pytest.mark.parametrize("code", [errno.EIO, errno.ENOSPC])
def test_a_folder_whose_disk_failed_is_cleaned_by_the_same_command(place, tmp_path, monkeypatch, code):
    make(place)
    with gsmap.map.open(place) as m:
        m.export(tmp_path / "out", format="ply", tile_size_m=0, merge="union")
        failing = [OSError(code, os.strerror(code))]
        remove = purge.remove_file

        def removed(*where):
            if failing:
                raise failing.pop()
            return remove(*where)

        monkeypatch.setattr(purge, "remove_file", removed)
        with raises((DiskError, DiskFullError), code=("disk_failed", "disk_full")):
            m.purge(NAME)
        assert m.purge(NAME).exports == (str(tmp_path / "out"),)
        assert list((tmp_path / "out").rglob("*.ply")) == []


def test_a_tile_outside_the_folder_stays(place, tmp_path):
    """A ``tiles.json`` that names a file beside its folder."""
    make(place)
    (tmp_path / "component_0").mkdir()
    victim = tmp_path / "component_0" / "precious.ply"
    victim.write_bytes(b"precious")
    with gsmap.map.open(place) as m:
        m.export(tmp_path / "out", format="ply", tile_size_m=0, merge="union")
        file = tmp_path / "out" / "tiles.json"
        for odd in ("../component_0/precious.ply", str(victim)):
            text = json.loads(file.read_text())
            text["tiles"][0]["path"] = odd
            file.write_text(json.dumps(text))
            shutil.copytree(place, tmp_path / "again")
            with gsmap.map.open(tmp_path / "again") as copy:
                assert any(str(tmp_path / "out") in text for text in copy.purge(NAME).unreachable)
            shutil.rmtree(tmp_path / "again")
        shutil.rmtree(tmp_path / "out" / "component_0")
        os.symlink(tmp_path / "component_0", tmp_path / "out" / "component_0")
        text["tiles"][0]["path"] = "component_0/precious.ply"
        file.write_text(json.dumps(text))
        m.purge(NAME)
    assert victim.read_bytes() == b"precious"


def test_a_reader_of_the_state_before_is_waited_for(place):
    make(place)
    with gsmap.map.open(place) as m:
        reader = sqlite3.connect(place / "map.sqlite", isolation_level=None)
        reader.execute("BEGIN")
        reader.execute("SELECT count(*) FROM scenes").fetchone()
        with raises(BusyError, code="purge_pending"):
            m.purge(NAME)
        reader.close()
        report = m.purge(NAME)  # its name is gone already: what is left undone is done
        assert report.num_rows["scenes"] == 1
    assert finds(place, NAME, NOTE, SOURCE) == []


def _die_at(path, step, pipe):
    """Purge, and die at the given change of the disk; tells where, or that it came through."""
    left = [step]

    def hook(event, arguments):
        if changes_disk(event, arguments):
            left[0] -= 1
            if left[0] == 0:
                pipe.send(f"died at {event}")
                os._exit(9)

    with gsmap.map.open(path) as m:
        sys.addaudithook(hook)
        m.purge(NAME)
        left[0] = -1
    pipe.send("through")


@pytest.mark.parametrize("stride", [pytest.param(1, marks=pytest.mark.slow), 6])
def test_killed_anywhere_the_same_command_finishes(tmp_path, start, stride):
    secret = make(tmp_path / "first.gsmap")
    with gsmap.map.open(tmp_path / "first.gsmap") as m:
        m.export(tmp_path / "tiles", format="ply", tile_size_m=0, merge="union")
    deaths = 0
    for step in range(1, 1000, stride):
        path = tmp_path / "site.gsmap"
        shutil.rmtree(path, ignore_errors=True)
        shutil.copytree(tmp_path / "first.gsmap", path)
        process, pipe = start(_die_at, str(path), step)
        process.join()
        through = pipe.poll(0) and pipe.recv() == "through"
        with gsmap.map.open(path) as m:
            try:
                m.purge(NAME)
            except NotFoundError:
                assert m.purge(secret).num_rows["scenes"] == 1
            assert m.check().ok
            assert m.store.scenes.list()[0].name == "hall"
        assert finds(path, NAME, NOTE, SOURCE) == []
        assert not (path / "arrays" / "scenes" / secret).exists()
        if through:
            break
        deaths += 1
    assert deaths >= 3


def _export_tree(m, out):
    """3D Tiles of a map whose tiles of 2 m have coarser levels above them."""
    m.export(out, tile_size_m=2, merge="union", format="3dtiles")
    folder = out / "component_0"
    assert list((folder / "levels").iterdir())
    return folder


def test_coarser_levels_go_and_come_again(place, tmp_path):
    secret = make(place)
    out = tmp_path / "out"
    with gsmap.map.open(place) as m:
        folder = _export_tree(m, out)
        levels = {p.name: p.read_bytes() for p in (folder / "levels").iterdir()}
        report = m.purge(secret)
        assert list(out.rglob("*.glb")) == []
        assert not folder.exists()
        assert report.num_tiles >= len(levels) + 1
        m.export(out, tile_size_m=2, merge="union", format="3dtiles")
        assert (folder / "tileset.json").is_file()
        for level in (folder / "levels").iterdir():
            assert level.read_bytes() not in levels.values()


def test_a_streamed_sog_goes_and_comes_again(place, tmp_path):
    secret = make(place)
    out = tmp_path / "out"
    with gsmap.map.open(place) as m:
        m.export(out, tile_size_m=2, merge="union", format="streamed-sog")
        assert len(gsmap.read(out / "component_0" / "lod-meta.json")) == 240
        m.purge(secret)
        assert not (out / "component_0").exists()
        m.export(out, tile_size_m=2, merge="union", format="streamed-sog")
        assert len(gsmap.read(out / "component_0" / "lod-meta.json")) == 160


def test_levels_of_an_export_that_was_killed_go(place, tmp_path):
    """The tiles are of today, but the levels above them are from before the scene was removed."""
    secret = make(place)
    out = tmp_path / "out"
    with gsmap.map.open(place) as m:
        folder = _export_tree(m, out)
        before = {p.name for p in (folder / "levels").iterdir()}
        m.remove(secret)
        m.optimize()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("gsmap.map.stages.export.write_tilesets", lambda *a, **options: None)
            m.export(out, tile_size_m=2, merge="union", format="3dtiles")
        tiles = set(folder.glob("*.glb"))
        assert {p.name for p in (folder / "levels").iterdir()} == before
        report = m.purge(secret)
        assert str(out) in report.exports
        assert not (folder / "levels").exists()
        assert not (folder / "tileset.json").exists()
        assert set(folder.glob("*.glb")) == tiles  # made without it


def test_levels_of_other_components_stay(place, tmp_path):
    secret = make(place)
    out = tmp_path / "out"
    with gsmap.map.open(place) as m:
        graph = m.store.revisions.get()
        poses = {s: p if s != secret else ScenePose(s, p.S_map_scene, 1, "placed") for s, p in graph.poses.items()}
        m.store.revisions.save(PoseGraph(poses, {}))
        folder = _export_tree(m, out)
        kept = {p: p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}
        assert (out / "component_1" / "tileset.json").is_file()
        m.purge(secret)
        assert not (out / "component_1").exists()
        assert {p: p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()} == kept


def test_files_that_an_export_had_still_to_delete_go(place, tmp_path):
    secret = make(place)
    out = tmp_path / "out"
    with gsmap.map.open(place) as m:
        m.export(out, format="ply", tile_size_m=0, merge="union")
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("gsmap.export.write._remove_doomed", lambda *a: None)
            m.remove(secret)
            m.optimize()
            m.export(out, tile_size_m=0, merge="union", format="spz")
        old = list(out.rglob("*.ply"))
        kept = list(out.rglob("*.spz"))
        assert old
        assert json.loads((out / "tiles.json").read_text())["doomed"]
        report = m.purge(secret)
        assert report.num_tiles == len(old)
        assert list(out.rglob("*.ply")) == []
        assert list(out.rglob("*.spz")) == kept
        assert "doomed" not in json.loads((out / "tiles.json").read_text())


@pytest.mark.parametrize("at", ["remove_file", "save"])
def test_killed_among_the_levels_the_next_purge_finishes(place, tmp_path, start, at):
    secret = make(place)
    out = tmp_path / "out"
    with gsmap.map.open(place) as m:
        _export_tree(m, out)
    tiles = len(list(out.rglob("*.glb")))
    process, _ = start(_die_cleaning, str(place), secret, at)
    process.join()
    assert process.exitcode == 9
    named = [tile["path"] for tile in json.loads((out / "tiles.json").read_text())["tiles"]]
    assert all((out / path).is_file() for path in named if path)
    with gsmap.map.open(place) as m:
        report = m.purge(secret)
    assert report.exports == (str(out),)
    assert report.num_tiles == tiles
    assert [p for p in out.rglob("*") if p.name != "tiles.json"] == []
    assert secret not in (out / "tiles.json").read_text()


def _die_cleaning(path, secret, at, pipe):
    """Die before the manifest of the folder is written, or when its first file is to go."""
    from gsmap.export.manifest import Manifest
    from gsmap.map.stages import purge

    setattr(Manifest if at == "save" else purge, at, lambda *_: os._exit(9))
    with gsmap.map.open(path) as m:
        m.purge(secret)


@pytest.mark.parametrize("again", ["restored", "ingested", "purged"])
def test_backups_since_the_scene_first_came_are_told_of(place, again):
    secret = make(place)
    with gsmap.map.open(place) as m:
        m.store.backups.add("/mnt/b", "first", 10)
        if again == "purged":
            m.purge(secret)
        else:
            m.remove(secret)
        if again == "restored":
            m.restore_scene(secret)
        else:
            m.store.scenes.add(make_gaussians(80, seed=1), make_cameras(), name="anew")
        m.store.backups.add("/mnt/b", "second", 10)
        assert m.purge(secret).backups == ("/mnt/b first", "/mnt/b second")


def test_backups_from_before_it_came_are_not_told_of(place):
    make(place)
    with gsmap.map.open(place) as m:
        m.store.backups.add("/mnt/b", "before", 10)
        late = m.store.scenes.add(make_gaussians(50, seed=9), make_cameras(), name="late")[0]
        assert m.purge(late.id).backups == ()


def test_a_branch_knows_the_backups_of_its_map(place):
    secret = make(place)
    with gsmap.map.open(place) as m:
        m.branch("b")
        m.store.backups.add("/mnt/b", "both", 10)
    with gsmap.map.open(f"{place}@b") as branch:
        assert branch.purge(secret).backups == ("/mnt/b both",)


def test_a_receipt_is_true_after_the_branches_were_purged(place):
    secret = make(place)
    with gsmap.map.open(place) as m:
        m.branch("b")
        m.branch("c")
        assert len(m.purge(NAME).branches) == 2
        m.delete_branch("c")
        assert m.purge(secret).branches == (f"{place}@b",)
        assert m.purge(secret, branches=True).branches == ()
        report = m.purge(secret)
        assert report.branches == ()
        assert report.maps == (str(place),)
        assert all(row.receipt["branches"] == [] for row in purging.list_purges(m.store))

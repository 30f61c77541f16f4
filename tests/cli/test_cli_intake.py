"""Folders as people have them: bad captures are set aside, other files skipped, wrong first commands answered."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from raising import raises

import gsmap.map
from gsmap import formats
from gsmap.errors import GsmapError, InputError
from gsmap.formats import cameras_json
from gsmap.ingest import search_captures
from gsmap.types import Cameras, Gaussians

Run = Callable[..., Any]


def splat(seed: int = 0, n: int = 60) -> Gaussians:
    rng = np.random.default_rng(seed)
    quats = np.tile([1.0, 0, 0, 0], (n, 1))
    return Gaussians(rng.uniform(-1, 1, (n, 3)), quats, np.full((n, 3), -3.0), np.zeros(n), rng.normal(size=(n, 1, 3)))


def write(path: Path, seed: int) -> Path:
    """A capture with its cameras, so that none are synthesised."""
    formats.write(path, splat(seed))
    pose = np.eye(4)
    pose[2, 3] = -4.0
    cameras = Cameras(pose[None], np.array([[40.0, 40, 16, 12]]), np.array([[32, 24]]), ("a",))
    cameras_json.write(path.with_name(f"{path.stem}.cameras.json"), cameras)
    return path


def point_cloud(path: Path) -> Path:
    """What INRIA's trainer leaves as points3D.ply: positions, normals and colours."""
    names = ("x", "y", "z", "nx", "ny", "nz")
    header = ["ply", "format binary_little_endian 1.0", "element vertex 5", *(f"property float {n}" for n in names)]
    header += [f"property uchar {n}" for n in ("red", "green", "blue")]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes("\n".join([*header, "end_header", ""]).encode() + bytes(5 * 27))
    return path


def with_values(path: Path, **values: float) -> None:
    """Put a value into row 7 of a field of a .ply."""
    gaussians = formats.read(path)
    for name, value in values.items():
        getattr(gaussians, name)[7] = value
    formats.write(path, gaussians)


def rewrite(path: Path, change: Callable[[bytes], bytes]) -> None:
    path.write_bytes(change(path.read_bytes()))


BAD: dict[str, Callable[[Path], object]] = {
    "cut": lambda p: rewrite(p, lambda b: b[:-700]),
    "cut in its header": lambda p: rewrite(p, lambda b: b[:90]),
    "empty": lambda p: rewrite(p, lambda b: b""),
    "zeros": lambda p: rewrite(p, lambda b: bytes(len(b))),
    "another file": lambda p: rewrite(p, lambda b: b"<html>404</html>"),
    "NaN": lambda p: with_values(p, means=np.nan),
    "huge": lambda p: with_values(p, log_scales=60.0),
    "no rotation": lambda p: with_values(p, quats=0.0),
    "no Gaussians": lambda p: formats.write(p, splat(0, 60)[np.zeros(60, bool)]),
    "damaged cameras": lambda p: p.with_name(f"{p.stem}.cameras.json").write_text('[{"id": 0'),
    "a date that is none": lambda p: p.with_name(f"{p.stem}.json").write_text('{"captured_at": "soon"}'),
    "a link to a file that is missing": lambda p: (p.unlink(), p.symlink_to("gone.ply")),
    "another format": lambda p: p.rename(p.with_suffix(".spz")),
}


@pytest.mark.parametrize("kind", BAD)
def test_one_bad_capture_ends_nothing(tmp_path: Path, kind: str, caplog: pytest.LogCaptureFixture) -> None:
    for k in range(4):
        write(tmp_path / f"night{k}.ply", k)
    BAD[kind](tmp_path / "night1.ply")
    with gsmap.map.create(tmp_path / "site.gsmap") as m:
        rows = m.ingest(tmp_path)
        assert [row.scene_name for row in rows] == ["night0", "night2", "night3"]
        assert [scene.name for scene in m.scenes()] == ["night0", "night2", "night3"]
        (todo,) = [row for row in m.status().todo if row.what == "set_aside"]
        assert "night1" in todo.meaning
        (aside,) = m.store.quarantine.encountered.values()
        assert Path(aside.about).name.startswith("night1.")
        assert aside.reason in caplog.text

        if kind.startswith("a"):  # another file lies there
            Path(aside.about).unlink()
        write(tmp_path / "night1.ply", 1)  # mended, as by a copy that was completed
        (tmp_path / "night1.json").unlink(missing_ok=True)
        m.ingest(tmp_path)
        assert len(m.scenes()) == 4
        assert m.store.quarantine.list() == []
        assert m.store.quarantine.encountered == {}


def test_the_command_goes_on_ends_with_3_and_names_it(cli: Run, captures: Path, tmp_path: Path) -> None:
    """One night: the good capture is described and solved; the next night tries the bad one again."""
    drop, site = tmp_path / "drop", tmp_path / "site.gsmap"
    drop.mkdir()
    for name in ("left.ply", "left.cameras.json"):
        shutil.copy(captures / name, drop / name)
    whole = write(tmp_path / "a.ply", 1).read_bytes()
    bad = drop / "a.ply"
    bad.write_bytes(whole[:-9])
    done = cli("update", site, drop)
    assert done.code == 3
    assert str(bad) in done.stderr.strip().splitlines()[-1]
    status = cli("status", site, "--json").json
    assert status["revision"] == 1  # the good one went all the way
    (todo,) = [row for row in status["todo"] if row["what"] == "set_aside"]
    assert todo["verb"] == f"gsmap update {site} --no-create {bad}"
    assert cli("update", site, drop, "--no-create").code == 3  # as long as the file lies there
    (two,) = [cli("ingest", site, bad, drop / "left.ply")]  # by name, as a shell's *.ply names them
    assert two.code == 3
    page = tmp_path / "report.html"
    assert cli("report", site, page, "--no-pictures").code == 0
    assert "a.ply" in page.read_text()
    assert str(tmp_path) not in page.read_text()  # a page goes to others
    bad.unlink()
    assert cli("update", site, drop, "--no-create").code == 0
    assert not [row for row in cli("status", site, "--json").json["todo"] if row["what"] == "set_aside"]


def test_the_one_file_that_is_named_fails_and_leaves_no_map(cli: Run, tmp_path: Path) -> None:
    bad = write(tmp_path / "a.ply", 0)
    BAD["NaN"](bad)
    done = cli("update", tmp_path / "site.gsmap", bad)
    assert done.code == 1
    assert str(bad) in done.stderr
    assert not (tmp_path / "site.gsmap").exists()


def test_a_map_that_fails_is_no_bad_capture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from gsmap.errors import DiskFullError

    write(tmp_path / "a.ply", 0)
    write(tmp_path / "b.ply", 1)
    with gsmap.map.create(tmp_path / "site.gsmap") as m:

        def full(*args: object, **options: object) -> None:
            raise DiskFullError("the disk is full")

        monkeypatch.setattr(m.store.scenes, "add", full)
        with pytest.raises(DiskFullError):
            m.ingest(tmp_path)
        assert m.store.quarantine.list() == []


# -- folders


def found(*paths: Path) -> list[str]:
    return [one.path.name for one in search_captures(paths).captures]


def test_a_trainers_folder_holds_one_capture(tmp_path: Path) -> None:
    """docs/start.md asks to keep the COLMAP folder beside a splat."""
    room = tmp_path / "room1"
    room.mkdir()
    formats.write(room / "splat.ply", splat())
    model = room / "sparse" / "0"
    point_cloud(model / "points3D.ply")
    (model / "cameras.txt").write_text("1 PINHOLE 64 48 50 50 32 24\n")
    (model / "images.txt").write_text("1 1 0 0 0 0 0 4 1 a.jpg\n\n")
    point_cloud(room / "input.ply")
    search = search_captures([tmp_path])
    assert [one.path for one in search.captures] == [room / "splat.ply"]
    assert search.captures[0].cameras == model
    assert search.captures[0].name == "room1"
    assert search.skipped == []
    rewrite(model / "points3D.ply", lambda b: b[:20])  # a damaged one is nobody's business either
    assert found(tmp_path) == ["splat.ply"]
    with raises(InputError, code="no_captures"):
        search_captures([room / "sparse"])


def test_clouds_meshes_maps_and_exports_are_skipped_and_named(tmp_path: Path) -> None:
    drop = tmp_path / "drop"
    point_cloud(drop / "a_lidar.ply")
    formats.write(drop / "hall.ply", splat())
    cameras_json.write(drop / "cameras.json", looking_at())
    glb(drop / "mesh.glb", {"asset": {"version": "2.0"}})
    gsmap.map.create(drop / "site.gsmap").close()
    (drop / "tiles" / "component_0").mkdir(parents=True)
    (drop / "tiles" / "tiles.json").write_text("{}")
    formats.write(drop / "tiles" / "component_0" / "0.ply", splat())
    search = search_captures([drop])
    assert [one.path.name for one in search.captures] == ["hall.ply"]
    assert search.captures[0].cameras == drop / "cameras.json"  # its own: the cloud is no second capture
    names = {"a_lidar.ply", "mesh.glb", "site.gsmap", "tiles"}
    assert {one.path.name for one in search.skipped} == names
    assert all(str(one.path) in one.reason for one in search.skipped)
    with gsmap.map.open(drop / "site.gsmap") as m:
        assert [row.scene_name for row in m.ingest(drop)] == ["hall"]
        assert m.store.quarantine.encountered == {}


def test_an_export_of_the_maps_own_scenes_is_no_capture(tmp_path: Path) -> None:
    formats.write(tmp_path / "hall.ply", splat())
    cameras_json.write(tmp_path / "hall.cameras.json", looking_at())
    with gsmap.map.create(tmp_path / "site.gsmap") as m:
        scene = m.ingest(tmp_path / "hall.ply")[0].scene
        m.update()
        m.export(tmp_path / "out", format="ply")
        exported = next((tmp_path / "out").glob("component_*/*.ply"))
        assert m.ingest(tmp_path / "out", tmp_path / "hall.ply")[0].scene == scene
        assert [row.id for row in m.scenes()] == [scene]
        with raises(InputError, code="own_export"):
            m.ingest(exported)
        garden = splat()
        garden.means[:] += 0.5
        formats.write(tmp_path / "out" / "garden.ply", garden)  # beside the export, not of it
        assert m.ingest(tmp_path / "out" / "garden.ply")[0].scene_name == "garden"
    with gsmap.map.create(tmp_path / "other.gsmap") as m:
        assert len(m.ingest(exported)) == 1


def looking_at() -> Cameras:
    pose = np.eye(4)
    pose[2, 3] = -4.0
    return Cameras(pose[None], np.array([[40.0, 40, 16, 12]]), np.array([[32, 24]]), ("a",))


def glb(path: Path, content: dict[str, Any]) -> None:
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    chunk = len(text).to_bytes(4, "little") + b"JSON" + text
    path.write_bytes(b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunk)).to_bytes(4, "little") + chunk)


def test_a_draft_of_splats_in_gltf_is_set_aside_not_skipped(tmp_path: Path) -> None:
    glb(
        tmp_path / "draft.glb", {"asset": {"version": "2.0"}, "extensionsUsed": ["KHR_spz_gaussian_splats_compression"]}
    )
    assert found(tmp_path) == ["draft.glb"]


def test_a_pipe_in_a_folder_is_skipped(tmp_path: Path) -> None:
    write(tmp_path / "a.ply", 0)
    os.mkfifo(tmp_path / "b.ply")
    search = search_captures([tmp_path])
    assert [one.path.name for one in search.captures] == ["a.ply"]
    assert [one.path.name for one in search.skipped] == ["b.ply"]


def photographs(folder: Path, count: int) -> Path:
    folder.mkdir(parents=True)
    for k in range(count):
        (folder / f"IMG_{k:04}.JPG").write_bytes(b"\xff\xd8")
    return folder


def test_photographs_alone_are_counted_and_leave_no_map(cli: Run, tmp_path: Path) -> None:
    folder = photographs(tmp_path / "photos", 40)
    for arguments in ([folder], sorted(folder.iterdir())):
        done = cli("update", tmp_path / "site.gsmap", *arguments)
        assert done.code == 1
        assert "40 photographs, but no splat" in done.stderr
        assert "gsmap localize" in done.stderr
        assert len(done.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "site.gsmap").exists()


def test_of_several_that_are_named_the_good_part_is_done(tmp_path: Path) -> None:
    folder = photographs(tmp_path / "photos", 3)
    good = write(tmp_path / "a.ply", 0)
    (tmp_path / "notes.txt").write_text("monday")
    (tmp_path / "none").mkdir()
    search = search_captures([folder, good, tmp_path / "notes.txt", tmp_path / "none"])
    assert [one.path for one in search.captures] == [good]
    assert [one.path.name for one in search.skipped] == ["photos", "notes.txt", "none"]


def test_nothing_but_clouds_is_an_error(tmp_path: Path) -> None:
    point_cloud(tmp_path / "lidar.ply")
    with raises(InputError, code="no_captures"):
        search_captures([tmp_path])
    with gsmap.map.create(tmp_path / "site.gsmap") as m, raises(InputError, code="not_gaussians"):
        m.ingest(tmp_path / "lidar.ply")


def test_a_folder_that_cannot_be_listed_is_set_aside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "a.ply", 0)
    (tmp_path / "locked").mkdir()
    listed = Path.iterdir

    def refused(folder: Path) -> Any:
        if folder.name == "locked":
            raise PermissionError(13, "Permission denied", str(folder))
        return listed(folder)

    monkeypatch.setattr(Path, "iterdir", refused)  # as root nothing is refused
    with gsmap.map.create(tmp_path / "site.gsmap") as m:
        assert [row.scene_name for row in m.ingest(tmp_path)] == ["a"]
        (aside,) = m.store.quarantine.list()
        assert aside.about == str(tmp_path / "locked")
        monkeypatch.undo()
        m.ingest(tmp_path)
        assert m.store.quarantine.list() == []


# -- wrong first commands


def test_a_forgotten_map_is_guessed(cli: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("captures").mkdir()
    write(Path("captures/hall.ply"), 0)

    def said(*arguments: str) -> str:
        done = cli(*arguments)
        assert done.code == 2
        assert len(done.stderr.strip().splitlines()) == 1
        return str(done.stderr)

    assert "gsmap update captures.gsmap captures\n" in said("update", "captures")
    assert "gsmap ingest hall.gsmap captures/hall.ply\n" in said("ingest", "captures/hall.ply")
    gsmap.map.create("site.gsmap").close()
    assert "gsmap update site.gsmap captures\n" in said("update", "captures")
    assert "gsmap update site.gsmap captures/hall.ply captures\n" in said("update", "captures/hall.ply", "captures")
    assert "gsmap update site.gsmap captures\n" in said("update", "captures", "site.gsmap")  # the wrong order
    gsmap.map.create("other.gsmap").close()
    assert "gsmap update MAP captures (MAP is one of other.gsmap, site.gsmap)\n" in said("update", "captures")
    photographs(Path("photos"), 2)
    assert "2 photographs, but no splat" in said("update", "photos")
    assert sorted(os.listdir()) == ["captures", "other.gsmap", "photos", "site.gsmap"]
    with gsmap.map.open("site.gsmap") as m:
        assert m.scenes() == []


def test_a_map_among_captures_is_for_merge(cli: Run, tmp_path: Path) -> None:
    gsmap.map.create(tmp_path / "a.gsmap").close()
    gsmap.map.create(tmp_path / "b.gsmap").close()
    done = cli("update", tmp_path / "a.gsmap", tmp_path / "b.gsmap")
    assert done.code == 1
    assert "gsmap merge" in done.stderr


# -- a map that is missing


def test_a_new_map_is_said_to_be_created(cli: Run, captures: Path, tmp_path: Path) -> None:
    site = tmp_path / "site.gsmap"
    missing = cli("update", site, captures / "left.ply", "--no-create")
    assert missing.code == 1
    assert str(site) in missing.stderr
    assert not site.exists()
    assert cli("update", site).code == 1  # of nothing no map is made
    assert not site.exists()
    first = cli("update", site, captures / "left.ply")
    assert first.code == 0
    assert f"created {site}" in first.stderr.splitlines()
    again = cli("update", site, captures / "left.ply", "--no-create")
    assert again.code == 0
    assert "created" not in again.stderr


def test_ingest_makes_a_map_as_update_does(cli: Run, captures: Path, tmp_path: Path) -> None:
    site = tmp_path / "site.gsmap"
    refused = [
        (captures / "left.ply", "--no-create"),
        (captures / "left.ply", "--supersedes", "left"),
        (captures / "left.ply", "--scale", "feet"),
        (captures, "--scale", "feet"),
        (captures, "--name", "hall"),
        (captures / "left.ply", "--captured-at", "soon"),
        (tmp_path / "gone.ply",),
    ]
    for arguments in refused:
        assert cli("ingest", site, *arguments).code in (1, 2), arguments
        assert not site.exists(), arguments
    first = cli("ingest", site, captures / "left.ply", "--name", "hall")
    assert first.code == 0
    assert f"created {site}" in first.stderr.splitlines()
    again = cli("ingest", site, captures / "right.ply")
    assert again.code == 0
    assert "created" not in again.stderr
    with gsmap.map.open(site) as m:
        assert [scene.name for scene in m.scenes()] == ["hall", "right"]


def test_a_missing_folder_makes_no_map(cli: Run, tmp_path: Path) -> None:
    assert cli("update", tmp_path / "site.gsmap", tmp_path / "gone").code == 1
    assert not (tmp_path / "site.gsmap").exists()
    with pytest.raises(GsmapError):
        search_captures([tmp_path / "gone"])

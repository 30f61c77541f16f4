"""Full and read-only disks: a map on one is copied elsewhere and localized in, and errors name the disk that failed."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from fault_verbs import words, write_samples
from raising import raises

import gsmap.map
from gsmap.cli import app
from gsmap.errors import DiskFullError
from gsmap.store import Store
from gsmap.types import PoseGraph, ScenePose, Sim3

Run = Callable[..., tuple[int, str]]


@pytest.fixture(scope="module")
def placed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of two captures of one room with poses, and no features."""
    folder = tmp_path_factory.mktemp("placed")
    write_samples(folder / "samples")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GSMAP_WORKERS", "1")
        for line in ("init MAP", "ingest MAP IN/then.ply IN/now.ply --scale known"):
            with pytest.raises(SystemExit) as ended:
                app.run(words(line, folder, folder / "samples"))
            assert not ended.value.code
    with Store.open(folder / "site.gsmap") as store:
        store.revisions.save(
            PoseGraph({one.id: ScenePose(one.id, Sim3.identity(), 0, "placed") for one in store.scenes.list()})
        )
    return folder / "site.gsmap"


@pytest.fixture
def mounted(tmp_path: Path) -> Iterator[Callable[[str, str], Path]]:
    """Mounts small file systems."""
    made: list[Path] = []

    def mount(name: str, size: str) -> Path:
        place = tmp_path / name
        place.mkdir()
        if subprocess.run(
            ["mount", "-t", "tmpfs", "-o", f"size={size}", "none", place], capture_output=True
        ).returncode:
            pytest.skip("needs the right to mount a small file system")
        made.append(place)
        return place

    yield mount
    for place in made:
        subprocess.run(["umount", "-l", place], check=True)


@pytest.fixture
def run(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """Runs a verb; returns its exit code and what it said on stderr."""
    monkeypatch.setenv("GSMAP_WORKERS", "1")
    monkeypatch.setenv("GSMAP_CACHE", str(tmp_path / "cache"))

    def one(*arguments: object) -> tuple[int, str]:
        with pytest.raises(SystemExit) as ended:
            app.run(list(map(str, arguments)))
        return int(ended.value.code or 0), capfd.readouterr().err

    return one


def fill(disk: Path) -> None:
    """Take every last byte."""
    with open(disk / "filler", "ab", buffering=0) as filler:
        for size in (1 << 16, 1 << 12, 1):
            with suppress(OSError):
                while True:
                    filler.write(b"x" * size)
    assert os.statvfs(disk).f_bfree == 0


def photo(path: Path) -> Path:
    from PIL import Image

    Image.fromarray(np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)).save(path)
    return path


KINDS = ["full", "full-after-a-kill", "read-only"]


@pytest.fixture
def unwritable(request: pytest.FixtureRequest, placed: Path, mounted: Callable[[str, str], Path]) -> Path:
    disk = mounted("source", "2m")
    shutil.copytree(placed, disk / "site.gsmap")
    if request.param == "full-after-a-kill":  # the log holds the newest commit
        store = Store.open(disk / "site.gsmap")
        store.scenes.edit("then", name="first")
        shutil.copytree(disk / "site.gsmap", disk / "killed", ignore=shutil.ignore_patterns("*-shm"))
        store.close()
        shutil.rmtree(disk / "site.gsmap")
        os.rename(disk / "killed", disk / "site.gsmap")
    if request.param == "read-only":
        subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
    else:
        fill(disk)
    return disk / "site.gsmap"


@pytest.mark.parametrize("unwritable", KINDS, indirect=True)
def test_a_map_that_cannot_be_written_is_copied_elsewhere(unwritable: Path, tmp_path: Path, run: Run) -> None:
    name = "first" if (unwritable / "map.sqlite-wal").exists() else "then"
    for line in (("backup", unwritable, tmp_path / "kept"), ("clone", unwritable, tmp_path / "clone.gsmap")):
        code, said = run(*line)
        assert code == 0, said
    assert run("restore", tmp_path / "kept", tmp_path / "back.gsmap")[0] == 0
    for folder in ("clone.gsmap", "back.gsmap"):
        with Store.open(tmp_path / folder) as store:
            assert store.check().ok
            assert {scene.name for scene in store.scenes.list()} == {name, "now"}
            store.scenes.edit("now", name="later")  # and it can be written


@pytest.mark.parametrize(
    "unwritable", [KINDS[0], *(pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS[1:])], indirect=True
)
def test_photos_are_localized_in_a_map_that_cannot_be_written(unwritable: Path, tmp_path: Path, run: Run) -> None:
    code, said = run("export", unwritable, tmp_path / "small", "--for", "localize")
    assert code == 0, said
    for place in (unwritable, tmp_path / "small"):
        code, said = run("localize", place, photo(tmp_path / "photo.png"))
        assert code == 0, said


@pytest.mark.parametrize(
    "line",
    [
        "backup MAP OUT",
        "clone MAP OUT",
        "split MAP OUT --scenes then",
        "export MAP OUT --for localize",
        "export MAP OUT --format ply --merge union",
        "view MAP --export OUT",
        "export MAP OUT.html --format html",
        "report MAP OUT.html",
        "poses MAP OUT.json",
    ],
)
def test_errors_name_the_full_destination(
    line: str, placed: Path, mounted: Callable[[str, str], Path], run: Run
) -> None:
    disk = mounted("destination", "128k")
    fill(disk)
    os.truncate(disk / "filler", os.path.getsize(disk / "filler") - (8 << 10))
    places = {"MAP": placed, "OUT": disk / "out", "OUT.html": disk / "out.html", "OUT.json": disk / "out.json"}
    if line.startswith(("report", "poses")):
        fill(disk)  # their files are small
    code, said = run(*(places.get(word, word) for word in line.split()))
    assert code == 1
    error = next(text for text in said.splitlines() if text.startswith("gsmap:"))
    assert str(disk / "out") in error
    assert str(placed) not in error
    assert "prune" not in error
    assert {entry.name for entry in disk.iterdir()} <= {"filler", "out"}
    if line.split()[0] in ("clone", "split", "view"):  # nothing half made is left
        assert not (disk / "out").exists()
    with Store.open(placed, "r") as store:
        assert store.check().ok


def test_a_copy_that_fails_names_its_target(placed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the source and the target of a copy are on one full disk, the operating system names both."""

    def full(source: Path, target: Path) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(source), None, str(target))

    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EXDEV, os.strerror(errno.EXDEV))

    monkeypatch.setattr("shutil.copyfile", full)
    monkeypatch.setattr("os.link", refuse)
    with gsmap.map.open(placed, "r") as m, raises(DiskFullError, code="disk_full", match="part.gsmap/arrays"):
        m.split(tmp_path / "part.gsmap", scenes=["then"])

"""OUT that is a link, a pipe or a device: written to as a shell would, and never replaced itself."""

from __future__ import annotations

import json
import os
import socket
import stat
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from raising import raises

from gsmap import formats
from gsmap.durable import write_output
from gsmap.errors import InputError

# Each verb that writes a file that a person names, and the suffix that it asks for.
VERBS = {
    "poses json": ("poses MAP OUT --format json", ".json"),
    "poses nerfstudio": ("poses MAP OUT --format nerfstudio", ".json"),
    "poses tum": ("poses MAP OUT --format tum", ".tum"),
    "poses g2o": ("poses MAP OUT --format g2o", ".g2o"),
    "graph json": ("graph MAP OUT", ".json"),
    "graph graphml": ("graph MAP OUT --format graphml", ".graphml"),
    "report": ("report MAP OUT --no-pictures", ".html"),
    "show": ("show MAP left --picture OUT", ".png"),
    "convert ply": ("convert CAPTURES/left.ply OUT", ".ply"),
    "convert spz": ("convert CAPTURES/left.ply OUT", ".spz"),
    "convert splat": ("convert CAPTURES/left.ply OUT", ".splat"),
    "convert sog": ("convert CAPTURES/left.ply OUT", ".sog"),
}


@pytest.fixture(scope="module")
def placed(made_site: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small map without its lone scene: one component, so that each form of its poses is one file."""
    import shutil

    import gsmap.map

    site = tmp_path_factory.mktemp("placed") / "site.gsmap"
    shutil.copytree(made_site, site)
    with gsmap.map.open(site) as m:
        m.remove("odd:one")
        m.optimize()
    return site


@pytest.fixture
def run(cli: Callable[..., Any], placed: Path, captures: Path) -> Callable[[str, Path], Any]:
    def call(line: str, out: Path) -> Any:
        words = line.replace("CAPTURES", str(captures)).split(" ")
        return cli(*[{"MAP": placed, "OUT": out}.get(word, word) for word in words])

    return call


def drained(pipe: Path, into: list[bytes]) -> threading.Thread:
    """Someone who reads a pipe to its end."""
    thread = threading.Thread(target=lambda: into.append(pipe.read_bytes()), daemon=True)
    thread.start()
    return thread


@pytest.mark.parametrize("verb", VERBS)
def test_a_link_stays_and_what_it_leads_to_is_replaced(verb: str, run: Callable[..., Any], tmp_path: Path) -> None:
    line, suffix = VERBS[verb]
    plain = tmp_path / f"plain{suffix}"
    assert run(line, plain).code == 0
    (tmp_path / "far").mkdir()
    real, link = tmp_path / "far" / "real", tmp_path / f"link{suffix}"
    real.write_bytes(plain.read_bytes() if verb == "report" else b"old")  # a report replaces nothing but a report
    before = real.stat().st_ino
    link.symlink_to(Path("far") / "real")
    assert run(line, link).code == 0
    assert os.readlink(link) == "far/real"
    assert real.stat().st_ino != before  # whole or not at all: renamed into place
    assert len(real.read_bytes()) == pytest.approx(len(plain.read_bytes()), rel=0.02)
    assert real.read_bytes()[:4] == plain.read_bytes()[:4]
    assert sorted(os.listdir(tmp_path / "far")) == ["real"]


@pytest.mark.parametrize("verb", VERBS)
def test_a_pipe_gets_what_a_file_would(verb: str, run: Callable[..., Any], tmp_path: Path) -> None:
    line, suffix = VERBS[verb]
    plain, pipe, got = tmp_path / f"plain{suffix}", tmp_path / f"pipe{suffix}", []
    assert run(line, plain).code == 0
    os.mkfifo(pipe)
    reader = drained(pipe, got)
    assert run(line, pipe).code == 0
    reader.join(20)
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert len(got[0]) == pytest.approx(len(plain.read_bytes()), rel=0.02)
    assert got[0][:4] == plain.read_bytes()[:4]


def test_a_device_stays_one(run: Callable[..., Any], tmp_path: Path) -> None:
    device = tmp_path / "null.json"
    try:
        os.mknod(device, 0o666 | stat.S_IFCHR, os.makedev(1, 3))
    except PermissionError:
        pytest.skip("this user may not make device nodes")
    for line in ("poses MAP OUT --format json", "graph MAP OUT"):
        assert run(line, device).code == 0
        assert stat.S_ISCHR(device.stat().st_mode)


@pytest.mark.parametrize("name", ["/dev/stdout", "/dev/fd/1", "/proc/self/fd/1"])
@pytest.mark.parametrize("to_file", [False, True])
def test_own_output_is_written_to(placed: Path, tmp_path: Path, name: str, to_file: bool) -> None:
    """Redirected to a file, what the shell's other commands wrote to it stays."""
    command = [sys.executable, "-P", "-m", "gsmap", "poses", str(placed), name, "--format", "json"]
    before = os.stat("/dev/stdout", follow_symlinks=False)
    if to_file:
        with open(tmp_path / "out", "wb") as out:
            out.write(b"before\n")
            out.flush()
            subprocess.run(command, stdout=out, check=True, timeout=120)
            out.seek(0, os.SEEK_END)
        first, _, rest = (tmp_path / "out").read_bytes().partition(b"\n")
        assert first == b"before"
    else:
        rest = subprocess.run(command, stdout=subprocess.PIPE, check=True, timeout=120).stdout
    assert len(json.loads(rest)["poses"]) == 2
    assert os.path.samestat(before, os.stat("/dev/stdout", follow_symlinks=False))


def test_several_components_do_not_fit_a_pipe(cli: Callable[..., Any], made_site: Path, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.tum")
    done = cli("poses", made_site, tmp_path / "pipe.tum", "--format", "tum")
    assert done.code == 1
    assert os.listdir(tmp_path) == ["pipe.tum"]


def test_nothing_else_is_replaced(captures: Path, tmp_path: Path) -> None:
    gaussians = formats.read(captures / "left.ply")
    (tmp_path / "folder.ply").mkdir()
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "socket.ply"))
        for name, code in (("folder.ply", "target_is_a_folder"), ("socket.ply", "not_writable")):
            before = (tmp_path / name).lstat()
            with raises(InputError, code=code):
                formats.write(tmp_path / name, gaussians)
            assert (tmp_path / name).lstat().st_ino == before.st_ino
    (tmp_path / "loop.ply").symlink_to("loop.ply")
    with pytest.raises(InputError):
        formats.write(tmp_path / "loop.ply", gaussians)
    assert (tmp_path / "loop.ply").is_symlink()
    os.mkfifo(tmp_path / "tileset.json")
    with raises(InputError, code="not_writable"):  # its tiles would lie beside it
        formats.write(tmp_path / "tileset.json", gaussians)
    assert sorted(os.listdir(tmp_path)) == ["folder.ply", "loop.ply", "socket.ply", "tileset.json"]


def test_a_link_that_leads_nowhere_yet_makes_its_file(tmp_path: Path) -> None:
    (tmp_path / "link.txt").symlink_to("new.txt")
    write_output(tmp_path / "link.txt", lambda staged: staged.write_text("new"))
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "new.txt").read_text() == "new"


def test_what_fails_leaves_the_file_behind_a_link_as_it_was(tmp_path: Path) -> None:
    (tmp_path / "real").write_text("old")
    (tmp_path / "link").symlink_to("real")

    def fail(staged: Path) -> None:
        staged.write_text("half")
        raise OSError("no")

    with pytest.raises(OSError, match="no"):
        write_output(tmp_path / "link", fail)
    assert (tmp_path / "real").read_text() == "old"
    assert sorted(os.listdir(tmp_path)) == ["link", "real"]

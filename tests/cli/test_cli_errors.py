"""Errors of the command line: refusals are one line; an internal error is one line and a log file."""

from __future__ import annotations

import errno
import re
import signal
import stat
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import gsmap.map
from gsmap.cli.stopping import StopSignal
from gsmap.cli.view import until_interrupted
from gsmap.map import Map
from gsmap.methods import families

Run = Callable[..., Any]


@pytest.fixture
def empty(tmp_path: Path) -> Path:
    """A map without scenes whose newest revision has no poses."""
    with gsmap.map.create(tmp_path / "site.gsmap") as m:
        m.optimize()
    return tmp_path / "site.gsmap"


@pytest.fixture
def logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of temporary files."""
    folder = tmp_path / "logs"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


@pytest.fixture
def broken_list(monkeypatch: pytest.MonkeyPatch) -> None:
    """``gsmap list`` divides by zero."""

    def fail(self: Map, **chosen: Any) -> Any:
        raise ZeroDivisionError("one\ntwo\x1b[31m")

    monkeypatch.setattr(Map, "scene_rows", fail)


@pytest.fixture
def broken_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An installed package that adds a method to every family, none of which can be imported."""
    about = tmp_path / "site" / "torn-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: torn\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(
        "\n".join(f"[{family.group}]\n.torn = torn_package" for family in families().values())
    )
    (tmp_path / "site" / "torn_package.py").write_text("1 / 0\n")
    monkeypatch.syspath_prepend(tmp_path / "site")


def test_measure_without_poses_is_refused(empty: Path, cli: Run, logs: Path) -> None:
    done = cli("measure", empty, "0,0,0", "1,0,0")
    assert done.code == 1
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1
    assert "gsmap update" in done.stderr
    assert list(logs.iterdir()) == []


def test_measure_refuses_a_component_that_does_not_exist(made_site: Path, cli: Run) -> None:
    done = cli("measure", made_site, "0,0,0", "1,0,0", "--component", 7)
    assert done.code == 1
    assert "no component 7: it has 0, 1" in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.usefixtures("broken_list")
def test_an_internal_error_is_one_line_and_a_log_file(empty: Path, cli: Run, logs: Path) -> None:
    done = cli("list", empty, "scenes")
    assert done.code == 1
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert "ZeroDivisionError: one" in line
    assert "two" not in line
    (log,) = logs.iterdir()
    assert str(log) in line
    assert stat.S_IMODE(log.stat().st_mode) == 0o600  # a traceback may hold what others may not read
    text = log.read_text()
    assert gsmap.__version__ in text
    assert "test_cli_errors.py" in text
    assert "ZeroDivisionError: one\ntwo" in text


@pytest.mark.usefixtures("broken_list", "logs")
def test_verbose_prints_the_traceback(empty: Path, cli: Run) -> None:
    err = cli("-v", "list", empty, "scenes").stderr
    assert re.search(r'File ".*test_cli_errors.py", line \d+, in fail', err)
    assert "\x1b" not in err


@pytest.mark.usefixtures("broken_list")
def test_an_error_that_cannot_be_logged_is_printed(empty: Path, cli: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*arguments: Any, **options: Any) -> Any:
        raise OSError(errno.ENOSPC, "no space left")

    with monkeypatch.context() as patched:
        patched.setattr("gsmap.cli.app.tempfile.NamedTemporaryFile", full)
        done = cli("list", empty, "scenes")
    assert done.code == 1
    assert "test_cli_errors.py" in done.stderr
    assert "ZeroDivisionError" in done.stderr.splitlines()[-1]


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("can't start new thread")])
def test_too_little_memory_is_one_line(
    error: Exception, empty: Path, cli: Run, logs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(self: Map, **chosen: Any) -> Any:
        raise error

    monkeypatch.setattr(Map, "scene_rows", fail)
    done = cli("list", empty, "scenes", "--json")
    assert (done.code, done.json["error"]["code"]) == (1, "out_of_memory")
    assert len(done.stderr.splitlines()) == 1
    assert list(logs.iterdir()) == []


@pytest.mark.parametrize(
    ("number", "code"),
    [
        (errno.ENOSPC, "disk_full"),
        (errno.EDQUOT, "disk_full"),
        (errno.EROFS, "read_only"),
        (errno.EIO, "disk_failed"),
        (errno.ENOTDIR, "system_refused"),
    ],
)
def test_an_error_of_the_system_has_a_code_and_names_what_was_written(
    number: int, code: str, empty: Path, cli: Run, logs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(self: Map, **chosen: Any) -> Any:
        raise OSError(number, "refused", "/the/source", None, "/the/target")

    monkeypatch.setattr(Map, "scene_rows", fail)
    done = cli("list", empty, "scenes", "--json")
    assert (done.code, done.json["error"]["code"]) == (1, code)
    (line,) = done.stderr.splitlines()
    assert ("/the/target" in line) == (code in ("disk_full", "read_only"))
    assert list(logs.iterdir()) == []


@pytest.mark.parametrize("sigma", ["1e308", "-1e308", "1e13"])
def test_coordinates_beyond_measure_are_refused(made_site: Path, cli: Run, sigma: str) -> None:
    for a in (f"{sigma},0,0", f"left:0,{sigma},0", f"world:0,0,{sigma}"):
        done = cli("measure", made_site, a, "1,0,0", "--component", 0, "--json")
        assert (done.code, done.json["error"]["code"]) == (2, "out_of_range"), done.stderr
    assert cli("measure", made_site, "1e-308,0,0", "1,0,0", "--component", 0).code == 0


@pytest.mark.parametrize("megabytes", ["1e308", "1e-308", "0", "nan", "inf", "-1"])
def test_a_page_of_no_sensible_size_is_refused(made_site: Path, cli: Run, tmp_path: Path, megabytes: str) -> None:
    done = cli("export", made_site, tmp_path / "p.html", "--format", "html", "--page-mb", megabytes, "--json")
    assert (done.code, done.json["error"]["code"]) == (2, "out_of_range")
    assert not (tmp_path / "p.html").exists()


@pytest.mark.usefixtures("broken_package")
def test_a_broken_plug_in_that_is_not_chosen_is_a_warning(tmp_path: Path, captures: Path, cli: Run) -> None:
    path = tmp_path / "new.gsmap"
    done = cli("update", path, captures / "left.ply")
    assert done.code == 0, done.stderr
    assert done.stderr.count("embedder '.torn' of the package torn cannot be loaded (ZeroDivisionError") == 1
    assert done.stderr.count("Traceback") == 0
    assert len(cli("list", path, "scenes", "--json").json["scenes"]) == 1
    for line in ("status", "settings", "changes", "models list"):
        verb, *rest = line.split()
        done = cli(verb, *rest, path, "--json")
        assert done.code == 0, done.stderr
    assert not [row for row in cli("settings", path, "--json").json["settings"] if ".torn" in row["name"]]


@pytest.mark.usefixtures("broken_package")
@pytest.mark.parametrize(
    "setting",
    [
        "describe.object.embedder=.torn",
        "describe.object.segmenter=.torn",
        "register.refiner=.torn",
        "localize.extractor=.torn",
        "merge.method=.torn",
    ],
)
def test_a_broken_plug_in_that_is_chosen_is_an_error(empty: Path, cli: Run, setting: str) -> None:
    done = cli("settings", empty, "--set", setting)
    assert done.code == 2
    assert "cannot be loaded" in done.stderr.splitlines()[-1]
    assert not (empty / "settings.toml").exists()


def test_a_failure_with_json_is_one_object_with_a_code(empty: Path, cli: Run) -> None:
    done = cli("measure", empty, "0,0,0", "1,0,0", "--json")
    assert done.code == 1
    assert done.json["error"]["code"] == "no_poses"
    assert done.stderr == f"gsmap: {done.json['error']['message']}\n"
    assert cli("list", empty, "tiles", "--set", "no.such=1", "--json").code == 2


@pytest.mark.parametrize(
    "words",
    [
        ("list", "MAP", "revisions", "--component", 0),
        ("list", "MAP", "tiles", "--tag", ""),
        ("export", "MAP", "map.html", "--format", "html", "--component", 0),
        ("export", "MAP", "map.html", "--format", "html", "--static"),
        ("export", "MAP", "plan.tif", "--wait"),
    ],
)
def test_an_option_that_does_not_apply_is_refused_even_if_it_is_zero(
    empty: Path, cli: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[object, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    done = cli(*(empty if word == "MAP" else word for word in words), "--json")
    assert done.json["error"]["code"] == "conflicting_options"


@pytest.mark.usefixtures("broken_list")
def test_an_internal_error_with_json_has_a_code(empty: Path, cli: Run, logs: Path) -> None:
    assert cli("list", empty, "scenes", "--json").json["error"]["code"] == "internal_error"


def test_ctrl_c_ends_the_page_and_other_signals_stop_the_verb() -> None:
    with until_interrupted():
        raise StopSignal(signal.SIGINT)
    for signum in (signal.SIGTERM, signal.SIGHUP):
        with pytest.raises(StopSignal) as stopped, until_interrupted():
            raise StopSignal(signum)
        assert stopped.value.signum == signum

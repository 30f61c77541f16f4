"""One export to a folder at a time; the second says who is at it, or waits; a crash leaves no lock."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from raising import raises

from gsmap.errors import BusyError, StoreError
from gsmap.export.lock import LOCK_FILE, folder_lock

HOLD = """
import sys, time
from pathlib import Path
from gsmap.export.lock import folder_lock
with folder_lock(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.readline()
"""


@pytest.fixture
def another(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """An export at work in ``out``; it ends when it is sent a line."""
    path = os.pathsep.join([str(Path(__file__).parents[2]), *sys.path])
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path / "out")],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": path},
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.communicate()


def test_the_second_is_told_who_is_at_it(tmp_path: Path, another: subprocess.Popen[str]) -> None:
    out = tmp_path / "out"
    (out / ".partial").mkdir()
    (out / ".partial" / "tile").touch()
    said = rf"{re.escape(str(out))}: gsmap export \(process {another.pid} on \S+, since \d\d:\d\d\)"
    with raises(BusyError, code="export_busy", match=said), folder_lock(out):
        pass
    assert (out / ".partial" / "tile").exists()
    assert (out / LOCK_FILE).exists()


def test_or_waits_for_it(tmp_path: Path, another: subprocess.Popen[str]) -> None:
    told: list[str] = []
    entered = threading.Event()

    def wait() -> None:
        with folder_lock(tmp_path / "out", wait=True, waiting=told.append):
            entered.set()

    thread = threading.Thread(target=wait)
    thread.start()
    time.sleep(1.2)
    assert not entered.is_set()
    assert [text.partition(" on ")[0] for text in told] == [f"waiting for gsmap export (process {another.pid}"]
    another.communicate("\n")
    assert entered.wait(10)
    thread.join()
    assert not (tmp_path / "out").exists()  # nobody put anything there


def test_a_killed_export_leaves_no_lock(tmp_path: Path, another: subprocess.Popen[str]) -> None:
    another.send_signal(signal.SIGKILL)
    another.wait()
    assert (tmp_path / "out" / LOCK_FILE).exists()
    with folder_lock(tmp_path / "out"):
        pass
    assert list((tmp_path / "out").iterdir()) == []


def test_of_many_one_at_a_time(tmp_path: Path) -> None:
    """The file goes with each holder: nobody must hold one that has lost its name."""
    (tmp_path / "kept").touch()
    inside, most = [0], [0]

    def enter() -> None:
        for _ in range(25):
            while True:
                try:
                    with folder_lock(tmp_path):
                        inside[0] += 1
                        most[0] = max(most[0], inside[0])
                        time.sleep(0.0005)
                        inside[0] -= 1
                    break
                except BusyError:
                    time.sleep(0.0001)

    threads = [threading.Thread(target=enter) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == [1]
    assert [path.name for path in tmp_path.iterdir()] == ["kept"]


def test_a_link_is_not_followed(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("precious")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / LOCK_FILE).symlink_to(victim)
    with raises(StoreError, code="not_writable"), folder_lock(tmp_path / "out"):
        pass
    assert victim.read_text() == "precious"


def test_a_file_in_place_of_the_folder_is_left_to_the_export(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("a file")
    with folder_lock(tmp_path / "out"):
        pass
    assert (tmp_path / "out").read_text() == "a file"

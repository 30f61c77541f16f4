"""Two seconds after any signal nothing of a run is alive, and a run that was asked to stop says one line."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from gsmap import platform
from tools.check.stop_sweep import alive

ROOT = Path(__file__).parents[2]
ASKED = {signal.SIGINT: "", signal.SIGTERM: " by SIGTERM", signal.SIGHUP: " by SIGHUP"}
LINE = "gsmap: interrupted{}; finished results are kept, run the same command again to continue\n"

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")

Start = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts ``tests/engine/stopped.py`` in a session of its own, and waits until it has begun."""
    started: list[subprocess.Popen[str]] = []

    def run(word: str, seconds: float = 60) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("stopped.py")), word, str(seconds)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path]), "OMP_NUM_THREADS": "1"},
        )
        started.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == "begun\n"
        return process

    yield run
    for process in started:
        for pid in alive(process.pid):
            os.kill(pid, signal.SIGKILL)
        process.communicate()


def wait_for_workers(process: subprocess.Popen[str]) -> None:
    """Until both are in a job."""
    assert process.stdout is not None
    assert [process.stdout.readline() for _ in range(2)] == ["working\n"] * 2


def seconds_until_gone(process: subprocess.Popen[str]) -> float:
    """Time until a run has ended, less what the slowest process of it, and at last this one, waited for a CPU.

    On a busy machine they may wait longer than they run; on an idle one next to nothing is left out.
    """
    began = time.monotonic()
    before = {pid: cpu_wait_s(pid) for pid in {process.pid, *alive(process.pid)}}
    waited = dict.fromkeys(before, 0.0)
    own = cpu_wait_s(os.getpid())
    while pids := alive(process.pid):
        own = cpu_wait_s(os.getpid())
        if time.monotonic() - began > 30:
            return float("inf")
        for pid in (process.pid, *pids):
            waited[pid] = max(waited.get(pid, 0.0), cpu_wait_s(pid) - before.get(pid, 0.0))
        time.sleep(0.01)
    return time.monotonic() - began - (cpu_wait_s(os.getpid()) - own) - max(waited.values())


def cpu_wait_s(pid: int) -> float:
    """Time that the threads of a process have been ready to run without a CPU; 0 if the kernel does not count it."""
    total_ns = 0
    with contextlib.suppress(OSError):  # it has ended
        for task in Path(f"/proc/{pid}/task").iterdir():
            with contextlib.suppress(OSError):
                total_ns += int((task / "schedstat").read_text().split()[1])
    return total_ns / 1e9


@pytest.mark.parametrize("signum", ASKED)
@pytest.mark.parametrize("whom", ["parent", "group"])
def test_a_signal_ends_all_with_one_line(start: Start, signum: signal.Signals, whom: str) -> None:
    process = start("sleep")
    wait_for_workers(process)
    (os.kill if whom == "parent" else os.killpg)(process.pid, signum)
    assert seconds_until_gone(process) < 2
    out, err = process.communicate()
    assert (out, err) == ("", LINE.format(ASKED[signum]))
    assert process.returncode == 128 + signum


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGKILL])
@pytest.mark.parametrize("delay_s", [0.0, 0.05, 0.15, 0.4])
def test_also_while_workers_are_started(start: Start, signum: signal.Signals, delay_s: float) -> None:
    process = start("sleep")
    time.sleep(delay_s)
    os.kill(process.pid, signum)
    assert seconds_until_gone(process) < 2
    _, err = process.communicate()
    assert err == (LINE.format("") if signum == signal.SIGINT else "")


holds_the_interpreter = pytest.param(
    "hog", marks=pytest.mark.skipif(not platform.IS_LINUX, reason="only a kernel ends what never runs its threads")
)


@pytest.mark.parametrize("word", ["compute", holds_the_interpreter])
def test_workers_end_with_a_parent_that_is_killed(start: Start, word: str) -> None:
    process = start(word)
    wait_for_workers(process)
    os.kill(process.pid, signal.SIGKILL)
    assert seconds_until_gone(process) < 2
    assert process.communicate()[1] == ""


@pytest.mark.parametrize("word", ["here", "hog here", "clean-up"])
def test_neither_native_code_nor_clean_up_holds_the_end_up(start: Start, word: str) -> None:
    process = start(word)
    time.sleep(0.2)
    os.kill(process.pid, signal.SIGTERM)
    assert seconds_until_gone(process) < 2
    assert process.communicate()[1] == LINE.format(" by SIGTERM")
    assert process.returncode == 143


def test_a_second_signal_ends_it_at_once(start: Start) -> None:
    process = start("clean-up")
    time.sleep(0.2)
    os.kill(process.pid, signal.SIGINT)
    time.sleep(0.2)
    os.kill(process.pid, signal.SIGINT)
    assert seconds_until_gone(process) < 0.8
    assert process.communicate()[1] == LINE.format("")
    assert process.returncode == 130


def test_a_signal_that_strikes_in_a_finalizer_is_not_lost(start: Start) -> None:
    process = start("finalizer")
    assert process.stdout is not None
    assert process.stdout.readline() == "in it\n"
    os.kill(process.pid, signal.SIGTERM)
    assert seconds_until_gone(process) < 1  # and not by the watch
    assert process.communicate()[1] == LINE.format(" by SIGTERM")
    assert process.returncode == 143


def test_who_ignores_a_signal_is_left_alone() -> None:
    """``nohup`` ignores SIGHUP for what it starts."""
    script = Path(__file__).with_name("stopped.py")
    code = (
        "import os, signal, sys; signal.signal(signal.SIGHUP, signal.SIG_IGN); "
        f"os.execv(sys.executable, [sys.executable, {str(script)!r}, 'sleep', '0.3'])"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])},
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"begun\n"
    process.send_signal(signal.SIGHUP)
    process.communicate()
    assert process.returncode == 0

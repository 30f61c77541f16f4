"""Several updates of one map at once: each result is made once, whoever is killed, and all end with the same map."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from raising import raises

import gsmap.map
from gsmap.errors import StoreError
from gsmap.store.revisions import Revisions
from gsmap.types import Cameras, Gaussians

ROOT = Path(__file__).parents[2]
NUM_SCENES = 4
NUM_PAIRS = 6

Start = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """Four scenes, of which nothing is known yet."""
    pose = np.eye(4)
    pose[2, 3] = -4.0
    cameras = Cameras(pose[None], np.array([[40.0, 40, 16, 12]]), np.array([[32, 24]]), ("a",))
    with gsmap.map.create(tmp_path / "site.gsmap") as m:
        for i in range(NUM_SCENES):
            rng = np.random.default_rng(i)
            means, sh = rng.uniform(-1, 1, size=(50, 3)), rng.normal(size=(50, 1, 3))
            quats = np.tile([1.0, 0, 0, 0], (50, 1))
            gaussians = Gaussians(means, quats, np.full((50, 3), -3.0), np.zeros(50), sh)
            m.ingest(gaussians, cameras=cameras, name=f"scene{i}", scale="known")
    return tmp_path / "site.gsmap"


def test_a_scene_purged_by_another_process_during_an_update_is_named(site, monkeypatch):
    save = Revisions.save

    def save_after_a_purge(self, *args, **kwargs):
        monkeypatch.undo()
        with gsmap.map.open(site) as other:
            other.purge("scene0")
        return save(self, *args, **kwargs)

    monkeypatch.setattr(Revisions, "save", save_after_a_purge)
    with gsmap.map.open(site) as m:
        with raises(StoreError, code="changed_meanwhile", match="scene0"):
            m.update()
        m.update()
        assert len(m.scenes()) == NUM_SCENES - 1


@pytest.fixture
def start(site: Path, tmp_path: Path) -> Iterator[Start]:
    """Starts an update of the map, which waits for `go`."""
    started: list[subprocess.Popen[str]] = []

    def run(seconds: float, workers: int = 1) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, str(ROOT / "tests/map/map_sharers.py"), str(site), str(tmp_path / "log"), str(seconds)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ
            | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path]), "GSMAP_WORKERS": str(workers)}
            | {"OMP_NUM_THREADS": "1"},
        )
        started.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        return process

    yield run
    for process in started:
        process.kill()
        process.communicate()


def go(process: subprocess.Popen[str]) -> None:
    assert process.stdin is not None
    process.stdin.write("\n")
    process.stdin.flush()


def log(site: Path) -> list[tuple[int, str]]:
    """What was begun by which run, in order."""
    path = site.with_name("log")
    lines = path.read_text().splitlines() if path.exists() else []
    return [(int(line.split(" ", 1)[0]), line.split(" ", 1)[1]) for line in lines]


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def counts(site: Path) -> tuple[int, int, int, int]:
    """Graphs, rows of registrations, revisions and leases."""
    with gsmap.map.open(site) as m:
        edges = sum(len(m.store.registrations.history(r.target, r.source)) for r in m.edge_rows())
        return len(m.store.graphs.list()), edges, len(m.store.revisions.list()), len(m.store.leases.list())


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_two_updates_share_the_work(site: Path, start: Start, workers: int) -> None:
    both = [start(0.3, workers), start(0.3, workers)]
    for process in both:
        go(process)
    answers = [process.communicate(timeout=120) for process in both]
    assert [process.returncode for process in both] == [0, 0], answers
    assert counts(site) == (NUM_SCENES, NUM_PAIRS, 1, 0)
    assert Counter(what for _, what in log(site)).most_common(1)[0][1] == 1
    assert len(log(site)) == NUM_SCENES + NUM_PAIRS
    assert {run for run, _ in log(site)} == {process.pid for process in both}
    assert answers[0][0] == answers[1][0]  # the same final state
    assert "gsmap update (process" in answers[0][1] + answers[1][1]
    assert "the remaining jobs are shared" in answers[0][1] + answers[1][1]


def test_the_share_of_a_killed_one_is_taken_over(site: Path, start: Start) -> None:
    slow, quick = start(60.0), start(0.05)
    go(slow)
    wait_until(lambda: len(log(site)) == 1)
    go(quick)
    wait_until(lambda: len(log(site)) == NUM_SCENES)  # all but that which the slow one is at
    time.sleep(1.0)
    assert quick.poll() is None
    with gsmap.map.open(site) as m:
        at_work = m.status().at_work
    assert {row.process for row in at_work} == {slow.pid, quick.pid}
    assert {row.task for row in at_work} == {"update"}
    slow.send_signal(signal.SIGKILL)
    killed = time.monotonic()
    first = log(site)[0][1]
    wait_until(lambda: [what for _, what in log(site)].count(first) == 2)
    assert time.monotonic() - killed < 10  # and not when its lease has run out
    _, err = quick.communicate(timeout=120)
    assert f"describe: waiting for gsmap update (process {slow.pid} on " in err
    assert quick.returncode == 0
    assert counts(site) == (NUM_SCENES, NUM_PAIRS, 1, 0)
    assert len(log(site)) == NUM_SCENES + NUM_PAIRS + 1


@pytest.mark.parametrize(
    ("stage", "after", "what"),
    [("graph", 2, f"of {NUM_SCENES} scenes are described"), ("edge", 3, f"of {NUM_PAIRS} pairs are registered")],
)
def test_who_is_interrupted_says_what_is_kept(site: Path, start: Start, stage: str, after: int, what: str) -> None:
    process = start(0.4)
    go(process)
    wait_until(lambda: sum(text.startswith(stage) for _, text in log(site)) > after)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=20)
    assert process.returncode == 130
    said = re.search(rf"^gsmap: interrupted; (\d) {what} and kept, run the same command again to continue$", err, re.M)
    assert said is not None, err
    graphs, edges, _, leases = counts(site)
    assert int(said[1]) == (graphs if stage == "graph" else edges)
    assert int(said[1]) >= after
    assert leases == 0


def test_a_script_without_its_guard_ends_and_says_so(site: Path, tmp_path: Path) -> None:
    """Its workers read it, come to the same update, and would wait for the process that waits for them."""
    script = tmp_path / "script.py"
    script.write_text(f"import gsmap.map\nwith gsmap.map.open({str(site)!r}) as m:\n    m.describe()\n")
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path]), "GSMAP_WORKERS": "2"}
    ended = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, env=env, timeout=60, check=False
    )
    assert ended.returncode == 1
    assert 'put what the script does below `if __name__ == "__main__":`' in ended.stderr
    assert "worker processes end before their first job" in ended.stderr

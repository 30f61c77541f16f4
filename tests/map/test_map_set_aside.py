"""Work that kills the process it runs in is left out, said, and done again when it is asked for by name."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from map_sharers import describe_scene

import gsmap.map
from gsmap.cli import console
from gsmap.cli.app import run
from gsmap.engine import QuarantinedJob
from gsmap.map import Map
from gsmap.types import Cameras, Gaussians

REASON = "its process was killed, most likely for lack of memory"


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Map]:
    """Three scenes; the jobs on `heavy` are set aside as long as ``GSMAP_TEST_HEAVY`` names a scene."""
    for name, value in (("LOG", str(tmp_path / "log")), ("SECONDS", "0"), ("RUN", "1")):
        monkeypatch.setenv(f"SHARERS_{name}", value)
    pose = np.eye(4)
    pose[2, 3] = -4.0
    cameras = Cameras(pose[None], np.array([[40.0, 40, 16, 12]]), np.array([[32, 24]]), ("a",))
    with gsmap.map.create(tmp_path / "site.gsmap") as m:
        for i, name in enumerate(("heavy", "light", "other")):
            rng = np.random.default_rng(i)
            means, sh = rng.uniform(-1, 1, size=(50, 3)), rng.normal(size=(50, 1, 3))
            quats = np.tile([1.0, 0, 0, 0], (50, 1))
            gaussians = Gaussians(means, quats, np.full((50, 3), -3.0), np.zeros(50), sh)
            m.ingest(gaussians, cameras=cameras, name=name, scale="known")
        heavy = next(scene.id for scene in m.scenes() if scene.name == "heavy")
        monkeypatch.setenv("GSMAP_TEST_HEAVY", heavy)

        def jobs(
            job: Callable[..., Any], arguments: Iterable[tuple[Any, ...]], params: Any, **how: Any
        ) -> Iterator[tuple[int, Any]]:
            for i, args in enumerate(arguments):
                is_heavy = os.environ["GSMAP_TEST_HEAVY"] in args
                yield i, QuarantinedJob(REASON) if is_heavy else describe_scene(*args)

        monkeypatch.setattr("gsmap.map.stages.describe.run_jobs", jobs)
        yield m


def described(m: Map) -> set[str]:
    names = {scene.id: scene.name for scene in m.scenes()}
    return {names[graph.scene] for graph in m.store.graphs.list()}


def test_the_rest_is_done_and_status_says_what_is_left(site: Map, caplog: pytest.LogCaptureFixture) -> None:
    site.describe()
    assert described(site) == {"light", "other"}
    (row,) = [row for row in site.status().todo if row.what == "set_aside"]
    assert row.meaning == f"heavy is quarantined: {REASON}"
    assert row.verb.endswith("site.gsmap heavy")
    assert row.verb.startswith("gsmap describe ")
    assert REASON in caplog.text


def test_it_is_left_out_until_it_is_asked_for(site: Map, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    site.describe()
    monkeypatch.setenv("GSMAP_TEST_HEAVY", "nobody")  # more memory
    site.describe()
    assert described(site) == {"light", "other"}
    assert len(site.store.quarantine.list()) == 1
    site.describe("heavy")
    assert described(site) == {"heavy", "light", "other"}
    assert site.store.quarantine.list() == []


def test_asked_for_and_killed_again_it_stays_aside(site: Map) -> None:
    site.describe()
    (before,) = site.store.quarantine.list()
    site.describe("heavy")
    (after,) = site.store.quarantine.list()
    assert (after.what, after.about) == (before.what, before.about)
    assert after.created_at >= before.created_at


def test_the_exit_code_says_that_something_is_left(site: Map, capsys: pytest.CaptureFixture[str]) -> None:
    for expected in (3, 3):  # by this run, and by the one before
        with pytest.raises(SystemExit) as ended:
            run(["describe", site.store.location])
        assert ended.value.code == expected
        assert "1 job is quarantined" in capsys.readouterr().err
    assert not console.left()
    with pytest.raises(SystemExit) as ended:
        run(["list", site.store.location, "scenes"])
    assert not ended.value.code


def test_a_scene_that_is_purged_takes_its_row_along(site: Map) -> None:
    site.describe()
    site.purge("heavy")
    assert site.store.quarantine.list() == []


def die(path: str, scene: str, *_: Any) -> Any:
    """A real job that is killed wherever it runs."""
    if scene == os.environ["GSMAP_TEST_HEAVY"]:
        os.kill(os.getpid(), signal.SIGKILL)
    return describe_scene(path, scene)


def test_killed_workers_for_real(site: Map, monkeypatch: pytest.MonkeyPatch) -> None:
    from gsmap.engine import run_jobs

    monkeypatch.setattr("gsmap.map.stages.describe.run_jobs", run_jobs)
    monkeypatch.setattr("gsmap.map.stages.describe.describe_scene", die)
    site.with_settings({"engine.executors.local.workers": 2})
    site.describe()
    assert described(site) == {"light", "other"}
    (row,) = [row for row in site.status().todo if row.what == "set_aside"]
    assert "killed, most likely for lack of memory" in row.meaning

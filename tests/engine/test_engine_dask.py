"""The executor dask, on a real cluster of two processes: the same bits as here, and nothing lost with a worker."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import dask_jobs
import pytest
from raising import raises

import gsmap.map
from gsmap import engine
from gsmap.engine.executors.dask import Params, start
from gsmap.errors import ConfigError, GsmapError, MissingDependencyError
from gsmap.methods.executor import QuarantinedJob
from gsmap_synthetic import make_captures, write_captures

distributed = pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A scheduler, and two workers of one thread that come back when they die."""
    path = os.pathsep.join([str(ROOT), str(Path(__file__).parent), *sys.path])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", path)
        patch.setenv("OMP_NUM_THREADS", "1")
        with distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
        ) as running:
            yield running


@pytest.fixture
def workers(cluster: Any) -> Iterator[Any]:
    found = start(Params(scheduler=cluster.scheduler_address))
    yield found
    found.close()


def test_jobs_give_what_they_give_here(workers: Any) -> None:
    assert dict(workers.run(dask_jobs.square, [(i,) for i in range(20)])) == {i: i * i for i in range(20)}
    assert dict(workers.run(dask_jobs.square, [])) == {}


def test_a_job_s_own_error_comes_through(workers: Any) -> None:
    with raises(GsmapError, code="out_of_range", match="no 1") as error:
        list(workers.run(dask_jobs.refuse, [(1,), (2,)]))
    assert type(error.value).__name__ == "InputError"
    assert "in refuse" in "".join(error.value.__notes__)


def test_arguments_are_taken_as_there_is_room(workers: Any) -> None:
    taken: list[int] = []

    def arguments() -> Iterator[tuple[int]]:
        for i in range(40):
            taken.append(i)
            yield (i,)

    for done, _ in enumerate(workers.run(dask_jobs.square, arguments()), 1):
        assert len(taken) <= done + 4 + 1


def test_a_job_that_kills_its_worker_twice_is_set_aside_and_the_rest_is_done(workers: Any, tmp_path: Path) -> None:
    found = dict(workers.run(dask_jobs.die_of_three, [(i, str(tmp_path / "tries")) for i in range(6)]))
    assert {i: value for i, value in found.items() if i != 3} == {0: 0, 1: 1, 2: 2, 4: 4, 5: 5}
    assert isinstance(found[3], QuarantinedJob)
    assert (tmp_path / "tries").read_text() == "xx"


def test_nothing_is_lost_with_a_worker(workers: Any, cluster: Any) -> None:
    def kill_one() -> None:
        time.sleep(1.0)
        with distributed.Client(cluster, set_as_default=False) as client:
            os.kill(next(iter(client.run(os.getpid).values())), signal.SIGKILL)

    killer = threading.Thread(target=kill_one)
    killer.start()
    found = list(workers.run(dask_jobs.nap, [(i, 0.1) for i in range(60)]))
    killer.join()
    assert sorted(found) == [(i, i) for i in range(60)], "each once"


def test_a_worker_of_another_version_gives_no_result(workers: Any, cluster: Any) -> None:
    with distributed.Client(cluster, set_as_default=False) as client:
        address = next(iter(client.scheduler_info()["workers"]))
        before = client.run(dask_jobs.set_version, "0.9.0", workers=[address])[address]
        try:
            with raises(GsmapError, code="worker_mismatch") as error:
                for index, value in workers.run(dask_jobs.nap, [(i, 0.05) for i in range(40)]):
                    assert value == index, "from the other worker"
            assert all(text in str(error.value) for text in (address, "0.9.0", before))
        finally:
            client.run(dask_jobs.set_version, before, workers=[address])
        assert dict(workers.run(dask_jobs.square, [(3,)])) == {0: 9}


def test_a_worker_whose_version_compares_none_is_a_mismatch(workers: Any, cluster: Any) -> None:
    with distributed.Client(cluster, set_as_default=False) as client:
        client.run(dask_jobs.set_signature_of_older_version)
        try:
            with raises(GsmapError, code="worker_mismatch"):
                list(workers.run(dask_jobs.square, [(1,)]))
        finally:
            client.run(dask_jobs.restore_signature)


def test_a_map_that_only_this_machine_sees_is_said_to_be_unseen_by_the_workers(workers: Any, tmp_path: Path) -> None:
    with raises(GsmapError, code="map_not_on_worker", match=workers._address):
        list(workers.run(dask_jobs.open_map, [(str(tmp_path / "unseen.gsmap"),)]))


def test_a_cluster_without_workers_is_waited_for_with_one_warning(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("gsmap.engine.executors.dask._WARN_AFTER_S", 0.5)
    monkeypatch.setattr("gsmap.engine.executors.dask._POLL_S", 0.1)
    with distributed.LocalCluster(n_workers=0, threads_per_worker=1, processes=False, dashboard_address=None) as empty:
        address = empty.scheduler_address
        late = threading.Timer(2.0, empty.scale, [1])
        late.start()
        waiting = start(Params(scheduler=address))
        assert dict(waiting.run(dask_jobs.square, [(i,) for i in range(3)])) == {0: 0, 1: 1, 2: 4}
        waiting.close()
        late.join()
    warned = [record.getMessage() for record in caplog.records if record.name == "gsmap.engine"]
    assert len(warned) == 1
    assert address in warned[0]


def test_no_scheduler_is_an_error_that_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("GSMAP_SCHEDULER", raising=False)
    with raises(ConfigError, code="missing_option", match="scheduler="):
        start(Params())
    with raises(GsmapError, code="scheduler_unreachable"):
        list(start(Params(scheduler="tcp://127.0.0.1:9", timeout_s=2)).run(dask_jobs.square, [(1,)]))
    monkeypatch.setitem(sys.modules, "distributed", None)
    with raises(MissingDependencyError, code="missing_dependency"):
        list(start(Params(scheduler="tcp://127.0.0.1:9")).run(dask_jobs.square, [(1,)]))


def test_workers_load_no_torch_for_their_jobs() -> None:
    code = "import sys, gsmap.map.jobs, gsmap.engine.executors.dask; print({'torch', 'gtsam'} & set(sys.modules))"
    path = os.pathsep.join([str(ROOT), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=os.environ | {"PYTHONPATH": path}
    )
    assert done.stdout == "set()\n", done.stderr


def test_a_map_made_on_a_cluster_is_the_same_to_the_bit(cluster: Any, tmp_path: Path) -> None:
    """Described, registered and exported; and once more where the machines share no folder with the export."""
    made = make_captures(0, 3, shut_doors=False, steps=0, num_frames=24, num_gaussians=25_000, size_px=(160, 120))
    write_captures(tmp_path / "captures", made)
    found = {}
    for executor in ("local", "dask"):
        values = {"engine.executor": executor, "engine.executors.local.workers": 1}
        if executor == "dask":
            values["engine.executors.dask.scheduler"] = cluster.scheduler_address
        with gsmap.map.create(tmp_path / f"{executor}.gsmap") as site:
            site.with_settings(values)
            site.update(tmp_path / "captures")
            site.export(tmp_path / executor, format="ply", tile_size_m=4.0, steps=10)
            rows = sorted(site.edge_rows(), key=lambda e: (e.target, e.source))  # committed as they were done
            edges = [(e.target, e.source, e.status, e.S_target_source, e.information) for e in rows]
            poses = {scene: pose.S_map_scene.matrix().tobytes() for scene, pose in site.pose_graph().poses.items()}
            graphs = sorted((one.key, one.scene, one.num_nodes) for one in site.store.graphs.list())
            arrays = sorted(group.name for group in (tmp_path / f"{executor}.gsmap" / "arrays" / "graphs").iterdir())
        tiles = {
            str(path.relative_to(tmp_path / executor)): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in (tmp_path / executor).rglob("*.ply")
        }
        found[executor] = (str(edges), poses, graphs, arrays, tiles)
    assert found["dask"] == found["local"]
    assert found["dask"][4]


def test_a_map_s_own_settings_choose_no_cluster(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A map may come from a stranger: nothing is connected to unasked."""
    with gsmap.map.create(tmp_path / "site.gsmap") as site:
        with raises(ConfigError, code="setting_of_run"):
            site.change_settings({"engine.executor": "dask"})
        (tmp_path / "site.gsmap" / "settings.toml").write_text(
            '[engine]\nexecutor = "dask"\n[engine.executors.dask]\nscheduler = "tcp://stranger:8786"\n'
            "[engine.executors.local]\nworkers = 3\n"
        )
        site.__dict__.pop("settings", None)
        assert site.settings.engine.executor == engine.AUTO
        assert site.settings.engine.executors["dask"].scheduler == ""
        assert site.settings.engine.executors["local"].workers == 3
    assert "engine.executors.dask.scheduler is ignored" in caplog.text

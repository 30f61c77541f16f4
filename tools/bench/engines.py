"""Executors: how well workers are used, what starting them costs, and what is lost when they are killed.

    python -m tools.bench.engines [--workers 2] [--jobs 100] [--soak 600] [--kill-every 30] [--wait] [--dask]
    python -m tools.bench.engines --update [--workers 2]
    python -m tools.bench.engines --commits 1000 --capture CAPTURE.ply

Efficiency is the CPU seconds that the jobs themselves take, over the wall seconds times the workers; on a machine that
does other work besides, CPU seconds of the whole over those of the jobs say more. The soak kills one of four workers
every so often; every job writes down that it was begun, every result is committed once, in a table of its own.

--commits: how many cores can describe for one process that commits. CPU seconds of describing one capture, CPU seconds
of the committing process for a result of that size, staged by workers or sent to it, and their quotient. The jobs are
stood in for: all are leased at once and return at once, as those of a large cluster.
"""

from __future__ import annotations

import argparse
import os
import pickle
import random
import resource
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

from gsmap.engine.executors import local
from tools.harness import argument_parser, timed


def burn(index: int, seconds: float, begun: str = "", wait: bool = False) -> tuple[int, float]:
    """A coarse job: so many CPU seconds, or seconds that it waits; returns those it took."""
    if begun:
        with open(begun, "a") as file:
            file.write(f"{index}\n")
    if wait:
        time.sleep(seconds)
        return index, seconds
    before = time.process_time()
    while time.process_time() - before < seconds:
        sum(i * i for i in range(20_000))
    return index, time.process_time() - before


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--jobs", type=int, default=100)
    parser.add_argument("--job-s", type=float, default=1.0)
    parser.add_argument("--soak", type=float, default=600.0, help="seconds; 0 for none")
    parser.add_argument("--kill-every", type=float, default=30.0)
    parser.add_argument(
        "--wait", action="store_true", help="jobs wait and compute nothing: for a machine that others use, too"
    )
    parser.add_argument("--dask", action="store_true", help="on a LocalCluster instead of the local pool")
    parser.add_argument("--update", action="store_true", help="instead: a map of 3 small scenes is given a fourth")
    parser.add_argument("--commits", type=int, default=0, help="instead: results that one process commits")
    parser.add_argument("--capture", type=Path, help="a capture of real size, for --commits")
    arguments = parser.parse_args()
    if arguments.commits:
        commits(arguments.capture, arguments.commits)
        return
    if arguments.update:
        update(arguments.workers)
        return
    with started(arguments.dask, arguments.workers) as workers:
        list(workers.run(burn, [(i, 0.01) for i in range(4 * arguments.workers)]))  # they are there now
        wall, cpu, idle = time.monotonic(), cpu_s(), idle_s()
        jobs = [(i, arguments.job_s, "", arguments.wait) for i in range(arguments.jobs)]
        took = sum(s for _, (_, s) in workers.run(burn, jobs))
        wall, idle = time.monotonic() - wall, idle_s() - idle
        what = "s of waiting" if arguments.wait else "CPU s"
        print(
            f"{arguments.jobs} jobs of {arguments.job_s:g} {what}, {arguments.workers} workers: {wall:.1f} s", end=", "
        )
        print(f"efficiency {took / (arguments.workers * wall):.2f} by the wall", end=", ")
        print(f"{took / (took + cpu_s() - cpu):.3f} by CPU; {idle:.1f} s of a processor were left idle", flush=True)
    if arguments.soak:
        soak(arguments)


def soak(arguments: argparse.Namespace) -> None:
    """Four workers, one killed every so often."""
    with tempfile.TemporaryDirectory() as folder, started(arguments.dask, 4) as workers:
        begun, ended = Path(folder, "begun"), threading.Event()
        begun.touch()
        deadline = time.monotonic() + arguments.soak
        killed: list[int] = []

        def kill() -> None:
            while not ended.wait(arguments.kill_every) and time.monotonic() < deadline:
                if processes := workers_below(os.getpid(), arguments.dask):
                    killed.append(random.choice(processes))
                    os.kill(killed[-1], signal.SIGKILL)

        submitted = 0

        def jobs() -> Iterator[tuple[Any, ...]]:
            nonlocal submitted
            while time.monotonic() < deadline:
                yield submitted, arguments.job_s, str(begun), arguments.wait
                submitted += 1

        committed = sqlite3.connect(Path(folder, "committed.sqlite"))
        committed.execute("CREATE TABLE done (job INTEGER)")
        killer = threading.Thread(target=kill)
        killer.start()
        aside = 0
        for index, result in workers.run(burn, jobs()):
            if not isinstance(result, tuple):
                aside += 1
                continue
            with committed:
                committed.execute("INSERT INTO done VALUES (?)", (index,))
        ended.set()
        killer.join()
        ((count, distinct),) = committed.execute("SELECT count(job), count(DISTINCT job) FROM done").fetchall()
        tries = len(begun.read_text().split())
        print(
            f"{arguments.soak:g} s, {len(killed)} workers killed: {submitted} jobs, "
            f"{submitted - distinct - aside} lost, "
            f"{aside} set aside, {tries - submitted} ({(tries - submitted) / submitted:.1%}) computed twice, "
            f"{count - distinct} committed twice"
        )


def update(most: int) -> None:
    """CPU seconds of ``gsmap update`` with one new scene, its workers included."""
    from gsmap_synthetic import make_captures, write_captures

    with tempfile.TemporaryDirectory() as folder:
        made = make_captures(0, 4, shut_doors=False, steps=0, num_frames=24, num_gaussians=25_000, size_px=(160, 120))
        paths = write_captures(Path(folder, "captures"), made)
        site = Path(folder, "site.gsmap")
        gsmap(1, "update", site, *paths[:3])
        for workers in sorted({1, most}):
            again = shutil.copytree(site, Path(folder, f"{workers}.gsmap"))
            spent = gsmap(workers, "update", again, paths[3])
            print(f"3 + 1 scenes, {workers} worker{'s' * (workers > 1)}: {spent:.1f} CPU s", flush=True)


def commits(capture: Path, count: int) -> None:
    """Print how many cores can describe for one committing process."""
    import gsmap.map
    from gsmap.map import jobs
    from gsmap.map.stages import describe

    made: list[Any] = []

    def job(*arguments: Any) -> Any:
        made.append(timed(jobs.describe_scene, *arguments))
        return made[0][0]

    with tempfile.TemporaryDirectory() as folder:
        unstaged = mock.patch.object(jobs, "staged", lambda results, found, key, inbox: found)
        with gsmap.map.create(Path(folder, "one.gsmap")) as m, unstaged:
            m.ingest(capture)
            with mock.patch.object(describe, "describe_scene", job):
                m.describe()
        found, job_s = made[0]
        print(f"{capture.name}: {job_s:.1f} CPU s to describe, {len(pickle.dumps(found)) / 1e6:.1f} MB of results")
        for staged, number in ((True, count), (False, min(count, 30))):
            took = committing(Path(folder, f"{staged}.gsmap"), found, number, staged)
            what = "staged by workers" if staged else "sent to the committing process"
            print(f"{number} results {what}: {1e3 * took:.1f} CPU ms to commit one, full at {job_s / took:.0f} cores")


def committing(path: Path, found: tuple[Any, Any], count: int, staged: bool) -> float:
    """CPU seconds for each of so many results, of the process that leases their jobs and commits them."""
    import gsmap.map
    from gsmap.map.stages import describe
    from gsmap.register.recipe import prepared_key
    from gsmap.store.arrays import Arrays, StagedGroup
    from tools.bench.values import make_scenes

    took = 0.0
    first: dict[str, StagedGroup] = {}
    write = Arrays.stage_into

    def link(self: Arrays, inbox: str, arrays: Any, kind: str, name: str) -> StagedGroup:
        """Stage the first group of each kind, and links to its files for all others."""
        if kind not in first:
            first[kind] = write(self, "kept", arrays, kind, name)
        made = self.staging / inbox / name
        shutil.copytree(first[kind].folder, made, copy_function=os.link)
        return StagedGroup(made, first[kind].files)

    def cluster(job: Any, arguments: Any, params: Any) -> Iterator[tuple[int, Any]]:
        """Take all jobs at once, and return their results one after the other; only the caller's time counts."""
        nonlocal took
        todo = list(arguments)
        ready = []
        took += time.process_time()
        for _, scene, _, _, key, inbox in todo:
            graph, prepared = replace(found[0], scene_id=scene), replace(found[1], scene=scene)
            if staged:
                graph = m.store.graphs.stage(graph, key, inbox)
                prepared = m.store.prepared_scenes.stage(prepared, prepared_key().of(scene, key.digest), inbox)
            ready.append(pickle.dumps((graph, prepared)))
        took -= time.process_time()
        for index, packed in enumerate(ready):
            yield index, pickle.loads(packed)

    with gsmap.map.create(path) as m:
        make_scenes(m, count)
        (m.store.arrays.staging / "kept").mkdir()
        with mock.patch.object(describe, "run_jobs", cluster), mock.patch.object(Arrays, "stage_into", link):
            took -= time.process_time()
            m.describe()
            took += time.process_time()
    return took / count


def gsmap(workers: int, *arguments: object) -> float:
    """CPU seconds that a verb takes, all processes that it starts included."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    env = os.environ | {"GSMAP_WORKERS": str(workers)}
    subprocess.run(
        [sys.executable, "-P", "-m", "gsmap", "-q", *map(str, arguments)],
        check=True,
        env=env,
        stdout=subprocess.DEVNULL,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


@contextmanager
def started(is_dask: bool, count: int) -> Iterator[Any]:
    if not is_dask:
        workers: Any = local.start(local.Params(workers=count))
        yield workers
        workers.close()
        return
    from distributed import LocalCluster

    from gsmap.engine.executors import dask

    os.environ["PYTHONPATH"] = os.pathsep.join(sys.path)
    with LocalCluster(n_workers=count, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        workers = dask.start(dask.Params(scheduler=cluster.scheduler_address))
        yield workers
        workers.close()


def workers_below(process: int, is_dask: bool) -> list[int]:
    """Ids of the worker processes that a process has started: of Dask's nannies those below them."""
    told = subprocess.run(["ps", "-eo", "pid,ppid,args"], capture_output=True, text=True, check=True).stdout
    rows = [line.split(None, 2) for line in told.splitlines()[1:]]
    word = "spawn_main" if is_dask else "worker.py"
    return [int(pid) for pid, parent, command in rows if int(parent) == process and word in command]


def cpu_s() -> float:
    """Of this process alone: what the executor itself takes."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def idle_s() -> float:
    """Seconds that processors of this machine had nothing to do since it was started."""
    return int(Path("/proc/stat").read_text().split()[4]) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    main()

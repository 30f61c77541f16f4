"""Jobs give the same results wherever they run, and a dead worker is an error, not a hang."""

from __future__ import annotations

import os
import pickle
import signal
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from raising import raises

from gsmap import engine
from gsmap.engine import QuarantinedJob, pool
from gsmap.engine.blas_threads import _controls, one_blas_thread
from gsmap.engine.executors.local import Params, start
from gsmap.errors import ConfigError, GsmapError


def run_jobs(job: Callable[..., Any], arguments: Iterable[tuple[Any, ...]], params: Params) -> Iterator[Any]:
    """As one stage does that keeps no workers."""
    workers = start(params)
    try:
        yield from workers.run(job, arguments)
    finally:
        workers.close()


def square(x: int) -> tuple[int, int]:
    return x * x, os.getpid()


def threads_of(x: int) -> tuple[str, int]:
    from gsmap.render import num_threads

    return os.environ["OPENBLAS_NUM_THREADS"], num_threads()


def die(x: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return x


def die_of_three(x: int) -> int:
    return die(x) if x == 3 else x


def die_once(x: int, folder: str) -> int:
    """The first of jobs dies when it is tried first; the others say when they ended."""
    if x == 0:
        tried = Path(folder, "tried")
        if not tried.exists():
            tried.touch()
            die(x)
        Path(folder, "began").write_text(f"0 {time.monotonic()}\n")
        return x
    time.sleep(0.05)
    with open(Path(folder, "ended"), "a") as file:
        file.write(f"{x} {time.monotonic()}\n")
    return x


def take_a_little(x: int) -> int:
    time.sleep(0.02)
    return os.getpid()


def refuse(x: int) -> int:
    raise ValueError(f"no {x}")


class Stubborn(Exception):
    """Cannot be made again from its arguments."""

    def __init__(self, a: str, b: str) -> None:
        super().__init__(f"{a} {b}")


def be_stubborn(x: int) -> int:
    raise Stubborn("one", "two")


def return_a_function(x: int) -> Callable[[], int]:
    return lambda: x


def echo(x: bytes) -> bytes:
    return x


def test_same_results_for_one_and_many_workers() -> None:
    inline = dict(run_jobs(square, [(i,) for i in range(6)], Params(workers=1)))
    spread = dict(run_jobs(square, [(i,) for i in range(6)], Params(workers=2)))
    assert {i: v for i, (v, _) in inline.items()} == {i: v for i, (v, _) in spread.items()}
    assert {pid for _, pid in inline.values()} == {os.getpid()}
    assert os.getpid() not in {pid for _, pid in spread.values()}


def spectrum(seed: int) -> bytes:
    square_root = np.random.default_rng(seed).normal(size=(150, 150))
    return bytes(np.linalg.eigh(square_root @ square_root.T)[0].tobytes())


def test_the_threads_of_blas_change_no_bit() -> None:
    found = []
    for count in (1, 2):
        with with_blas_threads(count):
            found += [dict(run_jobs(spectrum, [(i,) for i in range(8)], Params(workers=k))) for k in (1, 2)]
            assert dict(run_jobs(spectrum, [(0,)], Params(workers=2))) == {0: found[0][0]}  # one job alone
            assert {get() for get, _ in _controls()} == {count}  # as before
    assert all(one == found[0] for one in found)


def test_jobs_in_threads_of_one_process_leave_the_threads_of_blas_as_they_were() -> None:
    with with_blas_threads(2):
        first, second = one_blas_thread(), one_blas_thread()
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert {get() for get, _ in _controls()} == {1}  # the second job still runs
        second.__exit__(None, None, None)
        assert {get() for get, _ in _controls()} == {2}


@contextmanager
def with_blas_threads(count: int) -> Iterator[None]:
    """Another number of threads of BLAS than usual."""
    before = [get() for get, _ in _controls()]
    assert before, "numpy comes with OpenBLAS"
    for _, set_count in _controls():
        set_count(count)
    yield
    for was, (_, set_count) in zip(before, _controls(), strict=True):
        set_count(was)


def test_workers_share_the_processors(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("gsmap.platform.num_processors", lambda: 6)
    found = {result for _, result in run_jobs(threads_of, [(x,) for x in range(4)], Params(workers=2))}
    assert found == {("3", 3)}
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "5")
    found = {result for _, result in run_jobs(threads_of, [(x,) for x in range(4)], Params(workers=2))}
    assert found == {("5", 3)}, "what the user has set stays"


def test_a_job_that_kills_its_worker_twice_is_set_aside_and_the_rest_is_done() -> None:
    found = dict(run_jobs(die_of_three, [(i,) for i in range(6)], Params(workers=2)))
    assert {i: value for i, value in found.items() if i != 3} == {0: 0, 1: 1, 2: 2, 4: 4, 5: 5}
    assert isinstance(found[3], QuarantinedJob)
    assert "killed, most likely for lack of memory" in found[3].reason


def test_a_job_whose_worker_was_killed_once_is_done_when_nothing_else_runs(tmp_path: Path) -> None:
    """What it needs may be what others had: it is tried again alone."""
    found = dict(run_jobs(die_once, [(i, str(tmp_path)) for i in range(6)], Params(workers=2)))
    assert found == {i: i for i in range(6)}
    began = {int(line.split()[0]): float(line.split()[1]) for line in (tmp_path / "began").read_text().splitlines()}
    ended = {int(line.split()[0]): float(line.split()[1]) for line in (tmp_path / "ended").read_text().splitlines()}
    assert began[0] >= max(ended[i] for i in range(1, 6))


def test_workers_that_cannot_begin_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """And not a reason to set jobs aside."""
    monkeypatch.setattr("gsmap.engine.pool._WORKER", Path("/nowhere/worker.py"))
    with raises(GsmapError, code="workers_die"):
        list(run_jobs(square, [(1,), (2,)], Params(workers=2)))


def test_an_idle_worker_that_died_costs_no_job() -> None:
    workers = start(Params(workers=2))
    try:
        processes = {process for _, (_, process) in workers.run(square, [(i,) for i in range(4)])}
        for process in processes:
            os.kill(process, signal.SIGKILL)
        time.sleep(0.1)
        assert sorted(value for _, (value, _) in workers.run(square, [(i,) for i in range(4)])) == [0, 1, 4, 9]
    finally:
        workers.close()


def test_workers_are_kept_while_a_map_is_open() -> None:
    params = engine.Params(executors=engine.Params().executors.with_params("local", Params(workers=2)))

    def processes() -> set[int]:
        return {process for _, (_, process) in engine.run_jobs(square, [(i,) for i in range(6)], params)}

    with engine.WorkerSession():
        first = processes()
        assert processes() <= first
        with engine.WorkerSession():
            assert processes() <= first
        assert processes() <= first
    for process in first:
        with pytest.raises(ProcessLookupError):
            os.kill(process, 0)
    assert not processes() & first


class Sat(pool.Worker):
    """A worker that waits, and has read some scenes."""

    def __init__(self, *scenes: str) -> None:
        self.read = deque([frozenset([scene]) for scene in scenes])

    def is_alive(self) -> bool:
        return True


def test_jobs_run_where_what_they_read_was_read() -> None:
    """Idle workers and jobs ahead are matched by scenes; who has read none of them takes the first job."""
    hall, attic = Sat("cellar", "hall"), Sat("attic")
    workers = pool.Pool(3)
    workers._idle = [attic, hall]
    jobs = [("map", ("stairs", "key")), ("map", "hall", "stairs"), ("map", "attic"), ("map", "loft")]
    ahead = deque(pool._Task(i, job, pool._reads(job)) for i, job in enumerate(jobs))
    matched = [workers._matched(ahead) for _ in range(2)]
    assert {task.index: worker for worker, task in matched} == {1: hall, 2: attic}
    workers._idle = [attic]
    worker, task = workers._matched(ahead)
    assert (worker, task.index) == (attic, 0)


@pytest.mark.parametrize(("jobs", "here"), [(4, True), (400, False)])
def test_quick_jobs_start_workers_only_where_it_pays(jobs: int, here: bool) -> None:
    workers = start(Params(workers=2))
    try:
        found = dict(workers.run(take_a_little, [(i,) for i in range(jobs)], quick=True))
    finally:
        workers.close()
    assert set(found) == set(range(jobs))
    assert (set(found.values()) == {os.getpid()}) == here


def test_a_job_s_own_error_comes_through() -> None:
    with pytest.raises(ValueError, match="no"):
        list(run_jobs(refuse, [(1,), (2,)], Params(workers=2)))


def test_an_executor_is_chosen_by_name() -> None:
    assert sorted(v for _, (v, _) in engine.run_jobs(square, [(i,) for i in range(3)])) == [0, 1, 4]
    with raises(ConfigError, code="unknown_method", match="did you mean 'local'"):
        list(engine.run_jobs(square, [(1,)], engine.Params(executor="locl")))


def test_a_job_s_own_error_says_where_it_was_raised() -> None:
    with pytest.raises(ValueError) as error:
        list(run_jobs(refuse, [(1,), (2,)], Params(workers=2)))
    assert "in refuse" in "".join(getattr(error.value, "__notes__", ()))


def test_an_error_that_cannot_travel_is_told_all_the_same() -> None:
    with pytest.raises(RuntimeError, match="Stubborn: one two"):
        list(run_jobs(be_stubborn, [(1,), (2,)], Params(workers=2)))


def test_a_result_that_cannot_travel_is_an_error() -> None:
    with pytest.raises((AttributeError, TypeError, pickle.PicklingError), match=r"(?i)pickle"):
        list(run_jobs(return_a_function, [(1,), (2,)], Params(workers=2)))


def test_large_results_and_arguments_pass_each_other() -> None:
    """More than a socket holds, both ways at once."""
    big = bytes(3 << 20)
    assert {len(v) for _, v in run_jobs(echo, [(big,)] * 6, Params(workers=2))} == {3 << 20}


@pytest.mark.parametrize("workers", [1, 2])
def test_arguments_are_taken_as_there_is_room(workers: int) -> None:
    taken: list[int] = []

    def arguments() -> Iterator[tuple[int]]:
        for i in range(8):
            taken.append(i)
            yield (i,)

    for done, _ in enumerate(run_jobs(square, arguments(), Params(workers=workers)), 1):
        assert len(taken) <= done + 2 * workers  # as many ahead as run


def test_workers_end_when_nobody_wants_the_rest() -> None:
    results = run_jobs(square, [(i,) for i in range(20)], Params(workers=2))
    _, (_, worker) = next(results)
    assert isinstance(results, Generator)
    results.close()
    with pytest.raises(ProcessLookupError):
        os.kill(worker, 0)

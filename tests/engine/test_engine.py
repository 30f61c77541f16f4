"""Jobs give the same results wherever they run, and a dead worker is an error, not a hang."""

from __future__ import annotations

import os
import signal

import pytest

from gsmap import engine
from gsmap.engine.executors.local import Params, run_jobs
from gsmap.errors import ConfigError, GsmapError


def square(x: int) -> tuple[int, int]:
    return x * x, os.getpid()


def die(x: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return x


def refuse(x: int) -> int:
    raise ValueError(f"no {x}")


def test_same_results_for_one_and_many_workers() -> None:
    inline = dict(run_jobs(square, [(i,) for i in range(6)], Params(workers=1)))
    spread = dict(run_jobs(square, [(i,) for i in range(6)], Params(workers=2)))
    assert {i: v for i, (v, _) in inline.items()} == {i: v for i, (v, _) in spread.items()}
    assert {pid for _, pid in inline.values()} == {os.getpid()}
    assert os.getpid() not in {pid for _, pid in spread.values()}


def test_a_dead_worker_is_an_error() -> None:
    with pytest.raises(GsmapError, match="worker process died"):
        list(run_jobs(die, [(1,), (2,)], Params(workers=2)))


def test_a_job_s_own_error_comes_through() -> None:
    with pytest.raises(ValueError, match="no"):
        list(run_jobs(refuse, [(1,), (2,)], Params(workers=2)))


def test_an_executor_is_chosen_by_name() -> None:
    assert sorted(v for _, (v, _) in engine.run_jobs(square, [(i,) for i in range(3)])) == [0, 1, 4]
    with pytest.raises(ConfigError, match="did you mean 'local'"):
        list(engine.run_jobs(square, [(1,)], engine.Params(executor="locl")))

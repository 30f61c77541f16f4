"""Jobs give the same results wherever they run, and a dead worker is an error, not a hang."""

from __future__ import annotations

import os
import pickle
import signal
from collections.abc import Callable, Generator, Iterator

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
        assert len(taken) <= done + workers


def test_workers_end_when_nobody_wants_the_rest() -> None:
    results = run_jobs(square, [(i,) for i in range(20)], Params(workers=2))
    _, (_, worker) = next(results)
    assert isinstance(results, Generator)
    results.close()
    with pytest.raises(ProcessLookupError):
        os.kill(worker, 0)

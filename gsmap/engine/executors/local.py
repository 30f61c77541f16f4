"""Jobs in a pool of processes on this machine; in this process where that is as fast."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import chain, islice
from operator import length_hint
from typing import Any

from gsmap.engine.pool import Pool
from gsmap.errors import ConfigError

VERSION = 2


@dataclass(frozen=True)
class Params:
    """Args:
    workers: processes that compute at once; 0 takes every processor this process may use, or ``GSMAP_WORKERS``.
    start_s: CPU seconds that it takes to start one: quick jobs are spread only where more than that is gained.
    """

    workers: int = 0
    start_s: float = 0.9

    def __post_init__(self) -> None:
        if self.workers < 0:
            raise ConfigError(f"the number of workers must not be negative, got {self.workers}", code="out_of_range")
        if not self.start_s >= 0:
            raise ConfigError(f"start_s must not be negative, got {self.start_s}", code="out_of_range")


class LocalWorkers:
    """See `gsmap.methods.executor.Workers`; in the order of the arguments where there is one worker or one job."""

    def __init__(self, params: Params) -> None:
        self._start_s = params.start_s
        self._pool = Pool(params.workers or default_workers())

    def run(
        self, job: Callable[..., Any], arguments: Iterable[tuple[Any, ...]], *, quick: bool = False
    ) -> Iterator[tuple[int, Any]]:
        todo = enumerate(arguments)
        count = length_hint(arguments, _MANY)
        took_s: list[float] = []
        while self._pool.size == 1 or (quick and not self._is_worth_it(count, took_s)):
            taken = next(todo, None)
            if taken is None:
                return
            began = time.monotonic()
            result = job(*taken[1])
            took_s.append(time.monotonic() - began)
            yield taken[0], result
        first = list(islice(todo, 2))
        if len(first) == 1 and not self._pool.num_idle:
            index, args = first[0]
            yield index, job(*args)
            return
        yield from self._pool.run(job, chain(first, todo))

    def _is_worth_it(self, count: int, took_s: list[float]) -> bool:
        """Whether workers would do what is left of so many jobs sooner than this process, their start included."""
        if self._pool.num_idle:
            return True
        # The first job also pays for what it imports.
        saved_s = (count - len(took_s)) * min(took_s, default=0.0) * (1 - 1 / self._pool.size)
        return len(took_s) > 1 and saved_s > self._start_s

    def close(self) -> None:
        self._pool.close()


_MANY = 1_000_000  # jobs of which nobody told how many there are


def start(params: Params) -> LocalWorkers:
    return LocalWorkers(params)


def default_workers() -> int:
    """Processors this process may use; GSMAP_WORKERS says otherwise."""
    named = os.environ.get("GSMAP_WORKERS", "")
    if named.isdigit() and int(named) > 0:
        return int(named)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)

"""An executor that runs jobs in processes on this machine, or in this process if that is as fast."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import chain, islice
from operator import length_hint
from typing import Any

from gsmap import platform
from gsmap.engine.blas_threads import run_with_one_blas_thread
from gsmap.engine.pool import Pool
from gsmap.settings.ranges import require_range

VERSION = 2

_MANY = 1_000_000  # assumed number of jobs where it is unknown
_START_S = 0.9  # CPU seconds to start a process; quick jobs are spread only where more is gained


@dataclass(frozen=True)
class Params:
    """Settings of the local executor.

    Args:
        workers: Number of worker processes, at least 0; larger is faster and takes more memory. With 0, the environment
            variable ``GSMAP_WORKERS`` sets the number, and without it every available processor gets a worker.
    """

    workers: int = 0

    def __post_init__(self) -> None:
        require_range(self, "[0, inf]", "workers")


class LocalWorkers:
    """Worker processes of this machine; see `gsmap.methods.executor.Workers`. One worker yields results in order."""

    def __init__(self, params: Params) -> None:
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
            result = run_with_one_blas_thread(job, taken[1])
            took_s.append(time.monotonic() - began)
            yield taken[0], result
        first = list(islice(todo, 2))
        if len(first) == 1 and not self._pool.num_idle:
            index, args = first[0]
            yield index, run_with_one_blas_thread(job, args)
            return
        yield from self._pool.run(job, chain(first, todo))

    def _is_worth_it(self, count: int, took_s: list[float]) -> bool:
        """Return True if workers, including their start, would finish the remaining jobs sooner than this process."""
        if self._pool.num_idle:
            return True
        # The first job includes imports.
        saved_s = (count - len(took_s)) * min(took_s, default=0.0) * (1 - 1 / self._pool.size)
        return len(took_s) > 1 and saved_s > _START_S

    def close(self) -> None:
        self._pool.close()


def start(params: Params) -> LocalWorkers:
    return LocalWorkers(params)


def default_workers() -> int:
    """Return the number set by the environment variable GSMAP_WORKERS, or the number of available processors."""
    named = os.environ.get("GSMAP_WORKERS", "")
    if named.isdigit() and int(named) > 0:
        return int(named)
    return platform.num_processors()

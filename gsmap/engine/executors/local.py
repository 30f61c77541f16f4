"""Jobs in a pool of processes on this machine; in this process where there is one worker or one job."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import chain, islice
from typing import Any

from gsmap.engine.pool import Pool
from gsmap.errors import ConfigError

VERSION = 1


@dataclass(frozen=True)
class Params:
    """Args:
    workers: processes that compute at once; 0 takes every processor this process may use, or ``GSMAP_WORKERS``.
    """

    workers: int = 0

    def __post_init__(self) -> None:
        if self.workers < 0:
            raise ConfigError(f"the number of workers must not be negative, got {self.workers}")


def run_jobs(
    job: Callable[..., Any], arguments: Iterable[tuple[Any, ...]], params: Params | None = None
) -> Iterator[tuple[int, Any]]:
    """See `gsmap.methods.executor`; in the order of the arguments where there is one worker or one job."""
    workers = (params or Params()).workers or default_workers()
    todo = iter(arguments)
    first = list(islice(todo, 2)) if workers > 1 else []
    if len(first) > 1:
        with Pool(workers) as pool:
            yield from pool.run(job, chain(first, todo))
        return
    for index, args in enumerate(chain(first, todo)):
        yield index, job(*args)


def default_workers() -> int:
    """Processors this process may use; GSMAP_WORKERS says otherwise."""
    named = os.environ.get("GSMAP_WORKERS", "")
    if named.isdigit() and int(named) > 0:
        return int(named)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)

"""Jobs in a pool of processes on this machine; in this process where there is one worker or one job."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any

from gsmap.errors import ConfigError, GsmapError

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
    job: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], params: Params | None = None
) -> Iterator[tuple[int, Any]]:
    """See `gsmap.methods.executor`; in the order of the arguments where there is one worker or one job."""
    params = params or Params()
    workers = min(params.workers or default_workers(), len(arguments))
    if workers <= 1:
        for index, args in enumerate(arguments):
            yield index, job(*args)
        return
    # "spawn": a forked child inherits threads and locks of torch and OpenMP that no longer run in it.
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        futures = {pool.submit(job, *args): index for index, args in enumerate(arguments)}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BrokenProcessPool as error:
            raise GsmapError(
                "a worker process died, most likely for lack of memory: run again with GSMAP_WORKERS=1"
            ) from error
        finally:
            for future in futures:
                future.cancel()


def default_workers() -> int:
    """Processors this process may use; GSMAP_WORKERS says otherwise."""
    named = os.environ.get("GSMAP_WORKERS", "")
    if named.isdigit() and int(named) > 0:
        return int(named)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)

"""Where stage jobs run: in this process, or in a pool of local ones.

A job is a module-level function and small picklable arguments (paths and ids, never arrays): a worker opens the map
itself, computes, and sends the result back. Workers never write; the caller commits each result as it comes, so work
that is finished stays finished whatever happens to the rest.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from gsmap.errors import GsmapError


def default_workers() -> int:
    """Processors this process may use; GSMAP_WORKERS says otherwise."""
    named = os.environ.get("GSMAP_WORKERS", "")
    if named.isdigit() and int(named) > 0:
        return int(named)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


def run_jobs(
    job: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], workers: int | None = None
) -> Iterator[tuple[int, Any]]:
    """Yield ``(index, job(*arguments[index]))`` as each is done; in order when there is one worker or one job.

    Raises:
        GsmapError: a worker process died (out of memory, killed); what was yielded before stands.
        Exception: whatever a job raised; jobs not yet started are dropped.
    """
    workers = min(workers or default_workers(), len(arguments))
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

"""Run the jobs of stages: choose an executor, and keep its workers between stages."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from multiprocessing import current_process
from typing import Any

from gsmap.methods import MethodParams, family
from gsmap.methods.executor import QuarantinedJob, Workers

__all__ = ["WorkerSession", "Params", "QuarantinedJob", "is_beginning", "run_jobs"]

AUTO = "auto"


@dataclass(frozen=True)
class Params:
    """Settings of job execution. They hold for one run: the settings stored with a map cannot choose an executor.

    Args:
        executor: Executor that runs jobs: ``local`` (processes of this machine), ``dask`` (a running cluster), or one
            from another package; ``auto`` takes the executor that the environment variable ``GSMAP_EXECUTOR`` names, or
            ``local``.
        executors: Settings of each executor.
    """

    executor: str = AUTO
    executors: MethodParams = field(default_factory=lambda: MethodParams("executor"))

    def __post_init__(self) -> None:
        if self.executor != AUTO:
            family("executor").get(self.executor)

    def chosen(self) -> tuple[str, Any]:
        """Return the name and settings of the executor to use.

        Raises:
            ConfigError: there is none of that name.
        """
        name = self.executor if self.executor != AUTO else os.environ.get("GSMAP_EXECUTOR") or "local"
        family("executor").get(name)
        return name, self.executors[name]


def is_beginning() -> bool:
    """Return True in a worker that still imports the script that started it; no jobs may be started then."""
    return bool(getattr(current_process(), "_inheriting", False))


def run_jobs(
    job: Callable[..., Any], arguments: Iterable[tuple[Any, ...]], params: Params | None = None, *, quick: bool = False
) -> Iterator[tuple[int, Any]]:
    """Yield ``(index, job(*arguments))`` whenever a job is done; see `gsmap.methods.executor.Workers.run`.

    Workers that it starts stay for the next call as long as anything keeps them (`WorkerSession`).

    Raises:
        ConfigError: there is no such executor.
    """
    name, settings = (params or Params()).chosen()
    workers = _IDLE_WORKERS.take(name, settings)
    try:
        yield from workers.run(job, arguments, quick=quick)
    finally:
        _IDLE_WORKERS.give_back(name, settings, workers)


class WorkerSession(AbstractContextManager["WorkerSession"]):
    """A reference that keeps idle workers alive. Each open map has one; closing the last session ends all workers."""

    def __init__(self) -> None:
        self._open = True
        _IDLE_WORKERS.begin()

    def __exit__(self, *error: object) -> None:
        self.close()

    def __del__(self) -> None:
        self.close()

    def close(self) -> None:
        if self._open:
            self._open = False
            _IDLE_WORKERS.end()


class _IdleWorkers:
    """The idle workers of this process, by executor and settings."""

    def __init__(self) -> None:
        self._lock = threading.RLock()  # a finalizer may call within any call
        self._keepers = 0
        self._idle: list[tuple[str, Any, Workers]] = []

    def begin(self) -> None:
        with self._lock:
            self._keepers += 1

    def end(self) -> None:
        with self._lock:
            self._keepers -= 1
            ended = [] if self._keepers else self._idle
            if not self._keepers:
                self._idle = []
        for _, _, workers in ended:
            workers.close()

    def take(self, name: str, settings: Any) -> Workers:
        with self._lock:
            for i, (its_name, its_settings, workers) in enumerate(self._idle):
                if (its_name, its_settings) == (name, settings):
                    del self._idle[i]
                    return workers
        started: Workers = family("executor").get(name).start(settings)
        return started

    def give_back(self, name: str, settings: Any, workers: Workers) -> None:
        with self._lock:
            # One set of workers at most: those that an export in another thread leaves would only take memory.
            if self._keepers and not any(kept[:2] == (name, settings) for kept in self._idle):
                self._idle.append((name, settings, workers))
                return
        workers.close()


_IDLE_WORKERS = _IdleWorkers()

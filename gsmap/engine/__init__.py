"""Where stage jobs run: the executors, and the choice of one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

from gsmap.methods import MethodParams, family

__all__ = ["Params", "run_jobs"]


@dataclass(frozen=True)
class Params:
    """Where jobs run.

    Args:
        executor: ``local`` (a pool of processes on this machine), or one that another package adds.
        executors: settings of each executor.
    """

    executor: str = "local"
    executors: MethodParams = field(default_factory=lambda: MethodParams("executor"))

    def __post_init__(self) -> None:
        family("executor").get(self.executor)


def run_jobs(
    job: Callable[..., Any], arguments: Iterable[tuple[Any, ...]], params: Params | None = None
) -> Iterator[tuple[int, Any]]:
    """Yield ``(index, job(*arguments))`` as each is done; see `gsmap.methods.executor`.

    Raises:
        ConfigError: there is no such executor.
        GsmapError: a worker died; what was yielded before stands.
    """
    params = params or Params()
    executor = family("executor").get(params.executor)
    found: Iterator[tuple[int, Any]] = executor.run_jobs(job, arguments, params.executors[params.executor])
    return found

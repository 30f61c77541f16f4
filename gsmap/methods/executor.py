"""The contract of executors, which run the jobs of a stage."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol


@dataclass(frozen=True)
class QuarantinedJob:
    """The result of a job that was given up because it twice ended its worker process.

    Args:
        reason: what happened to the processes, for the user.
    """

    reason: str


class Workers(Protocol):
    """The worker processes of an executor, which are kept between stages and serve one stage at a time."""

    def run(
        self, job: Callable[..., Any], arguments: Iterable[tuple[Any, ...]], *, quick: bool = False
    ) -> Iterator[tuple[int, Any]]:
        """Yield ``(index, job(*arguments))`` whenever a job is done; the index counts ``arguments``, in any order.

        Arguments are taken as there is room to run them and little ahead, since taking them says to others that this
        process does them. Jobs that share an argument best run where the other one ran, which has read what it names.
        What runs is given up when the iterator is closed.

        A job whose process dies is retried once; if that process dies, too, its result is a `QuarantinedJob`, and the
        other jobs go on.

        Args:
            quick: true if a job takes no longer than starting a process. ``operator.length_hint`` of the arguments may
                give their number.

        Raises:
            GsmapError: no process can be started or reached; what was yielded before stands.
            Exception: whatever a job raised; jobs not yet started are dropped.
        """
        ...

    def close(self) -> None:
        """End all processes that were started, without waiting for them."""
        ...


class Executor(Protocol):
    """An executor, which runs jobs on this machine or on others.

    A job is a module-level function, and arguments that are small and picklable: the location of a map, ids, settings;
    never arrays. Whoever runs it opens the map for reading, computes, and sends the result back. Only the caller
    writes: it commits every result as it comes, so what is finished stays finished whatever becomes of the rest.

    Attributes:
        Params: frozen dataclass of its settings.
        VERSION: an int. An executor never changes a result, so no key names it.
    """

    Params: type
    VERSION: int

    def start(self, params: Any) -> Workers:
        """Return workers with these settings; their processes start with the first job.

        Raises:
            ConfigError: settings with which nothing can run.
        """
        ...

"""The contract of an executor: where the jobs of a stage run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol


@dataclass(frozen=True)
class SetAside:
    """In place of the result of a job that twice ended the process it ran in.

    Args:
        reason: what became of the processes, for a person.
    """

    reason: str


class Workers(Protocol):
    """Where an executor runs jobs; kept from one stage to the next, and used by one at a time."""

    def run(
        self, job: Callable[..., Any], arguments: Iterable[tuple[Any, ...]], *, quick: bool = False
    ) -> Iterator[tuple[int, Any]]:
        """Yield ``(index, job(*arguments))`` as each is done, in any order; the index counts the arguments.

        Arguments are taken as there is room to run them and little ahead, since taking them says to others that this
        process does them. Jobs that share an argument best run where the other one ran, which has read what it names.
        What runs is given up when the iterator is closed.

        A job whose process dies is tried once more; if that dies, too, its result is a `SetAside`, and the rest goes
        on.

        Args:
            quick: a job takes about as long as a process takes to start, or less. ``operator.length_hint`` of the
                arguments may tell how many there are.

        Raises:
            GsmapError: no process can be started or reached; what was yielded before stands.
            Exception: whatever a job raised; jobs not yet started are dropped.
        """
        ...

    def close(self) -> None:
        """End all processes that were started; none of them is waited for."""
        ...


class Executor(Protocol):
    """Runs jobs, here or elsewhere.

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
        """Where jobs run under these settings; nothing needs to be started before there is a job.

        Raises:
            ConfigError: settings with which nothing can run.
        """
        ...

"""The contract of an executor: where the jobs of a stage run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any, Protocol


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

    def run_jobs(
        self, job: Callable[..., Any], arguments: Iterable[tuple[Any, ...]], params: Any
    ) -> Iterator[tuple[int, Any]]:
        """Yield ``(index, job(*arguments))`` as each is done, in any order; the index counts the arguments.

        Arguments are taken as there is room to run them, since taking them says to others that this process does
        them; an executor that takes all of them at once keeps others from sharing the work. What runs is given up when
        the iterator is closed.

        Raises:
            GsmapError: a worker died; what was yielded before stands.
            Exception: whatever a job raised; jobs not yet started are dropped.
        """
        ...

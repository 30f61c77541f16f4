"""Run Python functions on as many threads as native kernels use (`gsmap.render.set_num_threads`)."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from gsmap._native import num_threads

_MOST = 4  # more threads wait for Python's lock: with 16, describing and merging are slower than with 4

Item = TypeVar("Item")
Result = TypeVar("Result")


def map_ahead(
    function: Callable[[Item], Result], items: Iterable[Item], threads: int | None = None
) -> Iterator[Result]:
    """Yield the results of a function, in the order of the items, while threads compute those of the next items.

    Args:
        items: taken by the calling thread; with T threads at most 2 T + 1 wait for their results.
        threads: 1 runs the function in the calling thread; None takes as many as native kernels do, at most `_MOST`.
    """
    threads = min(num_threads(), _MOST) if threads is None else threads
    if threads == 1:
        yield from map(function, items)
        return
    pool, pending = ThreadPoolExecutor(threads), deque[Future[Result]]()
    try:
        for item in items:
            pending.append(pool.submit(function, item))
            if len(pending) > 2 * threads:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


@contextlib.contextmanager
def run_aside(function: Callable[[], Result]) -> Iterator[Callable[[], Result]]:
    """Run a function on a thread of its own; the context is a function that waits for the result.

    With one thread, the function runs when its result is asked for.
    """
    if num_threads() == 1:
        yield function
        return
    with ThreadPoolExecutor(1) as pool:
        yield pool.submit(function).result

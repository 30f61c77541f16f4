"""Work on several items at once, in threads that share the renderers."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from gsmap.render.native import num_threads

Item = TypeVar("Item")
Result = TypeVar("Result")

_MOST = 8


def in_order(do: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """Yield ``do`` of every item in their order, at most twice as many of them under way as there are threads."""
    threads = min(num_threads(), _MOST)
    if threads == 1:
        yield from map(do, items)
        return
    pending: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        try:
            for item in items:
                if len(pending) == 2 * threads:
                    yield pending.popleft().result()
                pending.append(pool.submit(do, item))
            while pending:
                yield pending.popleft().result()
        finally:
            for future in pending:
                future.cancel()

"""What parts of a run cost, for benches: CPU seconds and calls of named functions, and SQL statements."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Any
from unittest import mock

from sqlalchemy import event


@dataclass(frozen=True)
class Spent:
    """By the names of parts: CPU seconds, without those of parts inside, and how often each was called."""

    seconds: Counter[str] = field(default_factory=Counter)
    times: Counter[str] = field(default_factory=Counter)


@contextmanager
def spent(steps: Sequence[tuple[str, Any, str]]) -> Iterator[Spent]:
    """Measure functions while this is open: of each the part's name, the module or class, and the function's name."""
    out, open_parts = Spent(), list[float]()

    def timed(part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def inside(*args: Any, **kwargs: Any) -> Any:
            start = time.process_time()
            open_parts.append(0.0)
            try:
                return function(*args, **kwargs)
            finally:
                took = time.process_time() - start
                out.seconds[part] += took - open_parts.pop()
                out.times[part] += 1
                if open_parts:
                    open_parts[-1] += took

        return inside

    with ExitStack() as stack:
        for part, where, name in steps:
            stack.enter_context(mock.patch.object(where, name, timed(part, getattr(where, name))))
        yield out


@contextmanager
def statements(engine: Any) -> Iterator[Counter[str]]:
    """Count the SQL statements, as ``sql``, that an engine executes while this is open."""
    counts: Counter[str] = Counter()

    def executed(*_: Any) -> None:
        counts["sql"] += 1

    event.listen(engine, "before_cursor_execute", executed)
    try:
        yield counts
    finally:
        event.remove(engine, "before_cursor_execute", executed)

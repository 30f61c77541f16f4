"""Measure the wall time of each step, in seconds."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Stopwatch:
    """Wall seconds of each step by its name; repeated steps are summed."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {"match": 0.0, "refine": 0.0, "verdict": 0.0}

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Add the wall seconds of the enclosed block to a step."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start

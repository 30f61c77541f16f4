"""Jobs for the tests of the executor dask: workers import this file by name, from ``PYTHONPATH``."""

from __future__ import annotations

import os
import signal


def square(x: int) -> int:
    return x * x


def refuse(x: int) -> int:
    raise ValueError(f"no {x}")


def die_of_three(x: int) -> int:
    if x == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return x

"""Jobs for the tests of the executor dask: workers import this file by name, from ``PYTHONPATH``."""

from __future__ import annotations

import os
import signal
import time

from gsmap.errors import InputError


def square(x: int) -> int:
    return x * x


def refuse(x: int) -> int:
    raise InputError(f"no {x}", code="out_of_range")


def die_of_three(x: int, tries: str) -> int:
    if x == 3:
        with open(tries, "a") as file:
            file.write("x")
        os.kill(os.getpid(), signal.SIGKILL)
    return x


def nap(x: int, seconds: float) -> int:
    time.sleep(seconds)
    return x

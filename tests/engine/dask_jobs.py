"""Jobs for the tests of the executor dask: workers import this file by name, from ``PYTHONPATH``."""

from __future__ import annotations

import os
import signal
import time

import gsmap.engine.executors.dask as executor
from gsmap.errors import InputError
from gsmap.store import Store


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


def set_version(version: str) -> str:
    """Let this worker be of another version of gsmap; return its version before."""
    before, executor.__version__ = executor.__version__, version
    return before


def set_signature_of_older_version() -> None:
    """Let this worker's `do` take no version, as that of gsmap 1.0.0rc1."""
    current = executor.do
    executor.do = lambda run, key, message: current(run, key, message, executor.__version__)


def restore_signature() -> None:
    executor.do = executor.do.__closure__[0].cell_contents


def open_map(path: str) -> str:
    with Store.open(path, "r") as store:
        return store.id

"""A run with two workers for the tests to send signals to: ``stopped.py WORD SECONDS``. Jobs do what WORD says."""

from __future__ import annotations

import sys
import time


def at_work() -> None:
    sys.stdout.write("working\n")  # at once: two workers write to one pipe
    sys.stdout.flush()


def sleep(seconds: float) -> float:
    at_work()
    time.sleep(seconds)
    return seconds


def compute(seconds: float) -> float:
    """Native code that lets the interpreter go but does not come back."""
    import numpy as np

    at_work()
    deadline = time.monotonic() + seconds
    big = np.ones((1500, 1500))
    while time.monotonic() < deadline:
        big @ big
    return seconds


def hog(seconds: float) -> float:
    """Native code that keeps the interpreter to itself: nothing of Python runs in this process meanwhile."""
    import ctypes

    at_work()
    ctypes.PyDLL(None).sleep(int(seconds))
    return seconds


class Slow:
    """What is raised in its finalizer is nowhere to be caught."""

    def __del__(self) -> None:
        print("in it", flush=True)
        deadline = time.monotonic() + 1
        while time.monotonic() < deadline:
            pass


def main() -> None:
    from gsmap.engine.executors.local import Params, start

    word, seconds = sys.argv[1], float(sys.argv[2])
    print("begun", flush=True)
    if word == "here":  # in the run's own process, where a signal finds native code
        import ctypes

        ctypes.CDLL(None).sleep(int(seconds))
        return
    if word == "hog here":
        hog(seconds)
    if word == "finalizer":
        Slow()
        while True:
            pass
    if word == "clean-up":  # that never ends
        try:
            time.sleep(seconds)
        finally:
            time.sleep(seconds)
    job = {"sleep": sleep, "compute": compute, "hog": hog}[word]
    for _ in start(Params(workers=2)).run(job, [(seconds,)] * 6):
        pass


if __name__ == "__main__":
    from gsmap.cli.stopping import stoppable

    with stoppable():
        main()

"""Handling of signals that stop a run: Ctrl-C, ``kill``, a closed terminal.

The first signal is an exception in the main thread, so that every ``finally`` on the way out runs: staged files go,
workers are killed, leases are given back. Then one line says what is kept. Native code does not see a signal before it
returns, and clean-up may hang on a dead disk; so a native thread, which the interpreter's signal handler wakes through
a pipe whatever runs, ends the process when it has not ended itself in time, or at a second signal.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType

# By two seconds after a signal nothing may be left, workers included; clean-up rarely takes a tenth of one.
_GRACE_S = 1.2

_AGAIN_S = 0.01  # after a signal struck where nothing can be raised, until it does again

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopSignal(BaseException):
    """Signal that ends this run; stages add a note of what is kept (`BaseException.add_note`)."""

    def __init__(self, signum: int) -> None:
        super().__init__(signum)
        self.signum = signum


@contextmanager
def stoppable() -> Iterator[None]:
    """End this process with one line and the exit code of shells on a signal that arrives within the context."""
    from gsmap._native import StopWatch

    ears, mouth = os.pipe()
    os.set_blocking(mouth, False)  # the interpreter insists on it
    watch = StopWatch(ears, _GRACE_S, {int(signum): _line(signum, ()) for signum in _SIGNALS})
    stopped: list[int] = []

    def raise_once(signum: int, frame: FrameType | None) -> None:
        if not stopped:
            stopped.append(signum)
            raise StopSignal(signum)

    def raise_again(signum: int, frame: FrameType | None) -> None:
        raise StopSignal(stopped[0])

    def swallowed(found: sys.UnraisableHookArgs) -> None:
        """It struck in a finalizer or a callback, where nothing can be raised (importing is full of them)."""
        if isinstance(found.exc_value, StopSignal):
            signal.signal(signal.SIGALRM, raise_again)
            signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)
        else:
            sys.__unraisablehook__(found)

    # What somebody had ignored (nohup, a job of a shell without job control) stays ignored.
    heard = [s for s in _SIGNALS if signal.getsignal(s) is not signal.SIG_IGN]
    try:
        sys.unraisablehook = swallowed
        signal.set_wakeup_fd(mouth, warn_on_full_buffer=False)
        for signum in heard:
            signal.signal(signum, raise_once)
        yield
    except StopSignal as stop:
        if watch.claim():
            with suppress(OSError, ValueError):
                sys.stdout.flush()
                sys.stderr.write(_line(stop.signum, getattr(stop, "__notes__", ())))
                sys.stderr.flush()
        os._exit(128 + stop.signum)  # waiting for no thread
    finally:
        stopped.append(0)
        signal.setitimer(signal.ITIMER_REAL, 0)
        sys.unraisablehook = sys.__unraisablehook__
        signal.set_wakeup_fd(-1)
        for signum in heard:
            signal.signal(signum, signal.SIG_DFL)  # what is left is the interpreter's own end: without a traceback
        os.close(mouth)  # which ends the watch


def _line(signum: int, notes: Sequence[str]) -> str:
    by = "" if signum == signal.SIGINT else f" by {signal.Signals(signum).name}"
    kept = "; ".join(notes) or "what was finished is kept"
    return f"gsmap: interrupted{by}; {kept}, run the same command again to go on\n"

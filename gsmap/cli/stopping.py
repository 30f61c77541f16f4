"""Handle the signals that stop a run: Ctrl-C, ``kill``, a closed terminal.

The first signal raises an exception in the main thread, so that every ``finally`` runs: staged files are deleted,
workers killed and leases released. Then one line names the results that are kept. Native code handles no signal before
it returns, and clean-up may hang on a dead disk; so a native thread, which the interpreter's signal handler wakes
through a pipe, ends the process after a grace time or at a second signal.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType

# Two seconds after a signal all processes, workers included, must have ended; clean-up rarely takes 0.1 s.
_GRACE_S = 1.2

_AGAIN_S = 0.01  # delay before the exception is raised again, if it came where none can be raised

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopSignal(BaseException):
    """A stop that a signal requested. Stages add notes on the results that are kept (`BaseException.add_note`)."""

    def __init__(self, signum: int) -> None:
        super().__init__(signum)
        self.signum = signum


@contextmanager
def stoppable() -> Iterator[None]:
    """Make a stop signal within the block end the process with one line and the exit code that shells use."""
    from gsmap._native import StopWatch

    read_end, write_end = os.pipe()
    os.set_blocking(write_end, False)  # required by set_wakeup_fd
    watch = StopWatch(read_end, _GRACE_S, {int(signum): _line(signum, ()) for signum in _SIGNALS})
    stopped: list[int] = []

    def raise_once(signum: int, frame: FrameType | None) -> None:
        if not stopped:
            stopped.append(signum)
            raise StopSignal(signum)

    def raise_again(signum: int, frame: FrameType | None) -> None:
        raise StopSignal(stopped[0])

    def raise_later(found: sys.UnraisableHookArgs) -> None:
        """Raise the stop again if a signal came in a finalizer or a callback, from which no exception can propagate."""
        if isinstance(found.exc_value, StopSignal):
            signal.signal(signal.SIGALRM, raise_again)
            signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)
        else:
            sys.__unraisablehook__(found)

    # Signals that the parent ignores (nohup, a shell without job control) stay ignored.
    handled = [s for s in _SIGNALS if signal.getsignal(s) is not signal.SIG_IGN]
    try:
        sys.unraisablehook = raise_later
        signal.set_wakeup_fd(write_end, warn_on_full_buffer=False)
        for signum in handled:
            signal.signal(signum, raise_once)
        yield
    except StopSignal as stop:
        if watch.claim():
            with suppress(OSError, ValueError):
                sys.stdout.flush()
                sys.stderr.write(_line(stop.signum, getattr(stop, "__notes__", ())))
                sys.stderr.flush()
        os._exit(128 + stop.signum)  # without waiting for threads
    finally:
        stopped.append(0)
        signal.setitimer(signal.ITIMER_REAL, 0)
        sys.unraisablehook = sys.__unraisablehook__
        signal.set_wakeup_fd(-1)
        for signum in handled:
            signal.signal(signum, signal.SIG_DFL)  # only the interpreter's shutdown is left: no traceback
        os.close(write_end)  # ends the watch


def _line(signum: int, notes: Sequence[str]) -> str:
    by = "" if signum == signal.SIGINT else f" by {signal.Signals(signum).name}"
    kept = "; ".join(notes) or "finished results are kept"
    return f"gsmap: interrupted{by}; {kept}, run the same command again to continue\n"

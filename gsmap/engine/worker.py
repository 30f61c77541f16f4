"""The script of worker processes of `gsmap.engine.pool`: ``worker.py SOCKET PARENT``.

It ends with its parent, however that ends (SIGKILL included), even before imports. On Linux the kernel kills it.
Elsewhere, or where the parent's thread may end before the parent, a thread ends it that reads the socket to the parent;
that fails while native code holds the interpreter lock.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

_REPORT_EVERY_S = 0.5


def end_with_parent(parent: int) -> None:
    """Make the kernel kill this process when the thread that started it ends, where it can (`gsmap.platform`).

    Args:
        parent: id of the process that started this one.
    """
    from gsmap import platform

    platform.end_with_thread_of_parent()
    if os.getppid() != parent:  # it ended before the call above
        os._exit(1)


def work(socket: int) -> None:
    """Run jobs until the parent ends or closes the socket. The first message lists the modules to import."""
    import logging
    import pickle
    import queue
    import threading
    from multiprocessing import process, spawn
    from multiprocessing.connection import Connection as Socket

    parent = Socket(socket)
    received: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def receive() -> None:
        # Reading all the time also keeps the parent from waiting for a worker that waits for the parent.
        while True:
            try:
                received.put(parent.recv_bytes())
            except (EOFError, OSError):
                os._exit(1)

    threading.Thread(target=receive, daemon=True).start()
    # A script without its `if __name__ == "__main__"` would start workers here, each of which would start workers.
    current = process.current_process()
    current._inheriting = True  # type: ignore[attr-defined]
    spawn.prepare(pickle.loads(received.get()))
    del current._inheriting  # type: ignore[attr-defined]
    logging.getLogger("gsmap.methods").setLevel(logging.ERROR)  # the parent has warned of methods that do not load
    parent.send_bytes(b"")  # the worker has begun: from now on only a job can end it
    while True:
        message = received.get()
        report_to(parent)
        parent.send_bytes(answer(message))


def report_to(parent: Connection) -> None:
    """Let the next job report its progress to the parent, at most twice a second: ``(None, (fraction, text))``."""
    import pickle
    import time

    from gsmap.types.progress import job_progress

    last_s = 0.0

    def report(fraction: float, text: str) -> None:
        nonlocal last_s
        if time.monotonic() - last_s >= _REPORT_EVERY_S:
            last_s = time.monotonic()
            parent.send_bytes(pickle.dumps((None, (fraction, text))))

    job_progress.set(report)


def answer(message: bytes) -> bytes:
    """Return the pickled result or error of a job: ``(True, result)`` or ``(False, error)``."""
    import pickle
    import traceback

    from gsmap.engine.blas_threads import run_with_one_blas_thread

    try:
        job, arguments = pickle.loads(message)
        return pickle.dumps((True, run_with_one_blas_thread(job, arguments)), pickle.HIGHEST_PROTOCOL)
    except BaseException as error:
        trace = "".join(traceback.format_exception(error))
        error.add_note(f"in a worker process:\n{trace.rstrip()}")
        try:
            packed = pickle.dumps((False, error.with_traceback(None)), pickle.HIGHEST_PROTOCOL)
            pickle.loads(packed)
        except Exception:  # an error whose class cannot be made again from its arguments
            packed = pickle.dumps((False, RuntimeError(trace.rstrip())), pickle.HIGHEST_PROTOCOL)
        return packed


if __name__ == "__main__":
    sys.path.append(str(Path(__file__).parents[2]))  # where gsmap lies; the parent sends its own path
    end_with_parent(int(sys.argv[2]))
    work(int(sys.argv[1]))

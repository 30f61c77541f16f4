"""What a worker process of `gsmap.engine.pool` runs, as a script: ``worker.py SOCKET PARENT``.

It ends with its parent, whatever ends that: SIGKILL included, and from before it has imported anything. On Linux the
kernel sees to it. Elsewhere, or where the parent's thread may end before the parent, a thread does, which reads the
socket that only the parent holds the other end of; it cannot while native code keeps the interpreter to itself.
"""

from __future__ import annotations

import os
import sys


def end_with_parent(parent: int) -> None:
    """Have the kernel kill this process when the thread that started it ends; nothing where there is no such thing.

    Args:
        parent: id of the process that started this one.
    """
    if sys.platform == "linux":
        import ctypes
        import signal

        pr_set_pdeathsig = 1  # <linux/prctl.h>
        ctypes.CDLL(None, use_errno=True).prctl(pr_set_pdeathsig, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before the kernel was told
        os._exit(1)


def work(socket: int) -> None:
    """Answer jobs until the parent ends or closes the socket. The first message says what to import."""
    import logging
    import pickle
    import queue
    import threading
    from multiprocessing import process, spawn
    from multiprocessing.connection import Connection

    parent = Connection(socket)
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
    parent.send_bytes(b"")  # it has begun: what ends it from now on is a job
    while True:
        parent.send_bytes(answer(received.get()))


def answer(message: bytes) -> bytes:
    """What a job returned or raised, as the parent can load it: ``(True, result)`` or ``(False, error)``."""
    import pickle
    import traceback

    try:
        job, arguments = pickle.loads(message)
        return pickle.dumps((True, job(*arguments)), pickle.HIGHEST_PROTOCOL)
    except BaseException as error:
        told = "".join(traceback.format_exception(error))
        error.add_note(f"in a worker process:\n{told.rstrip()}")
        try:
            packed = pickle.dumps((False, error.with_traceback(None)), pickle.HIGHEST_PROTOCOL)
            pickle.loads(packed)
        except Exception:  # an error whose class cannot be made again from its arguments
            packed = pickle.dumps((False, RuntimeError(told.rstrip())), pickle.HIGHEST_PROTOCOL)
        return packed


if __name__ == "__main__":
    end_with_parent(int(sys.argv[2]))
    work(int(sys.argv[1]))

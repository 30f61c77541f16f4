"""A pool of processes of which none outlives this one, and which is ended by killing: no running job is waited for.

The pools of the standard library wait for what runs when they are left, and their workers for ever when their parent is
killed. Workers start afresh ("spawn"): a forked child inherits threads and locks of torch and OpenMP that no longer run
in it.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from multiprocessing import Pipe, spawn
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from gsmap.errors import GsmapError

_WORKER = Path(__file__).with_name("worker.py")
_NOT_TO_WORKERS = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
"""A terminal and a service manager signal the whole group: what becomes of a worker is for its parent to say."""


class Worker:
    """A process that does one job after another."""

    def __init__(self) -> None:
        self.connection, theirs = Pipe()
        command = spawn.get_command_line()  # of which the interpreter and its options are wanted
        command = [*command[: command.index("-c")], str(_WORKER), str(theirs.fileno()), str(os.getpid())]
        before = signal.pthread_sigmask(signal.SIG_BLOCK, _NOT_TO_WORKERS)  # which the process inherits
        try:
            self._process = subprocess.Popen(command, pass_fds=(theirs.fileno(),), stdin=subprocess.DEVNULL)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            theirs.close()
        about = spawn.get_preparation_data("gsmap worker")  # the search path, the folder, and what `__main__` is
        about.pop("authkey", None)  # a secret, and of no use here
        self._send(pickle.dumps(about))

    def begin(self, job: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
        self._send(pickle.dumps((job, arguments), pickle.HIGHEST_PROTOCOL))

    def result(self) -> Any:
        """What the job returned; waits for it.

        Raises:
            GsmapError: the process died.
            Exception: what the job raised.
        """
        try:
            returned, value = pickle.loads(self.connection.recv_bytes())
        except (EOFError, OSError) as error:
            raise _died() from error
        if not returned:
            raise value
        return value

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()
        self.connection.close()

    def _send(self, message: bytes) -> None:
        try:
            self.connection.send_bytes(message)
        except OSError as error:
            raise _died() from error


class Pool(AbstractContextManager["Pool"]):
    """At most ``size`` workers, started as jobs come; all are killed at the end of the block."""

    def __init__(self, size: int) -> None:
        self.size = size
        self._workers: dict[Connection, Worker] = {}

    def __exit__(self, *error: object) -> None:
        for worker in self._workers.values():
            worker.kill()

    def run(self, job: Callable[..., Any], arguments: Iterable[tuple[Any, ...]]) -> Iterator[tuple[int, Any]]:
        """Yield ``(index, result)`` as each is done; the next arguments are taken when a worker is free for them."""
        todo = enumerate(arguments)
        at: dict[Connection, int] = {}

        def begin(worker: Worker | None) -> bool:
            taken = next(todo, None)
            if taken is None:
                return False
            if worker is None:
                worker = Worker()
                self._workers[worker.connection] = worker
            at[worker.connection], arguments = taken
            worker.begin(job, arguments)
            return True

        while len(at) < self.size and begin(None):
            pass
        while at:
            for connection in wait(list(at)):
                assert isinstance(connection, Connection)
                index, worker = at.pop(connection), self._workers[connection]
                result = worker.result()
                begin(worker)
                yield index, result


def _died() -> GsmapError:
    return GsmapError("a worker process died, most likely for lack of memory: run again with GSMAP_WORKERS=1")

"""A pool of worker processes that never outlive this process; closing it kills them without waiting for jobs.

The pools of the standard library wait for running jobs on exit, their workers outlive a killed parent, and one dead
worker ends them. Workers are spawned: a forked child inherits threads and locks of torch and OpenMP that do not run in
it.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator
from dataclasses import dataclass
from multiprocessing import Pipe, spawn
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from gsmap import platform
from gsmap.errors import GsmapError
from gsmap.methods.executor import QuarantinedJob
from gsmap.types.progress import jobs_progress

_WORKER = Path(__file__).with_name("worker.py")
_NOT_TO_WORKERS = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
"""Signals that workers ignore: terminals send them to the whole process group, but the parent ends its workers."""

_RECENT_JOBS = 4
"""Number of a worker's recent jobs that its next job should share inputs with, about as many as the worker caches."""

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

_MAX_LOSSES = 2
"""Number of lost processes after which a job is quarantined."""

_MAX_FALSE_STARTS = 3
"""Largest number of consecutive workers that may end before their first job."""


class WorkerDeath(Exception):
    """The process of a worker has ended."""


@dataclass(eq=False)
class _Task:
    """A job: its arguments, the arguments that may name input data, and the number of workers lost with the job."""

    index: int
    arguments: tuple[Any, ...]
    reads: frozenset[Hashable]
    losses: int = 0


class Worker:
    """A process that runs one job after another.

    Args:
        threads: number of threads of its native code and of the libraries that it uses; None leaves it to the
            environment.
    """

    def __init__(self, threads: int | None = None) -> None:
        self.connection, worker_end = Pipe()
        self.has_begun = False
        self.read: deque[frozenset[Hashable]] = deque(maxlen=_RECENT_JOBS)
        command = spawn.get_command_line()  # of which the interpreter and its options are wanted
        command = [*command[: command.index("-c")], str(_WORKER), str(worker_end.fileno()), str(os.getpid())]
        before = signal.pthread_sigmask(signal.SIG_BLOCK, _NOT_TO_WORKERS)  # which the process inherits
        try:
            self._process = subprocess.Popen(
                command, pass_fds=(worker_end.fileno(),), stdin=subprocess.DEVNULL, env=_environment(threads)
            )
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            worker_end.close()
        about = spawn.get_preparation_data("gsmap worker")  # search path, working directory and `__main__`
        about.pop("authkey", None)  # a secret, and of no use here
        self._unsent = [pickle.dumps(about)]

    def begin(self, job: Callable[..., Any], arguments: tuple[Any, ...], reads: frozenset[Hashable]) -> None:
        """Send a job to the worker, which must be idle.

        Raises:
            WorkerDeath: the process ended before.
        """
        self._unsent.append(pickle.dumps((job, arguments), pickle.HIGHEST_PROTOCOL))
        try:
            while self._unsent:
                self.connection.send_bytes(self._unsent.pop(0))
        except OSError as error:
            raise self._died() from error
        self.read.append(reads)

    def answer(self) -> tuple[bool | None, Any] | None:
        """Wait for (True, value) or (False, error) of the job; None if the worker reports only that it has started.

        A job that reports progress gives (None, (fraction, text)) before.

        Raises:
            WorkerDeath: the process ended.
        """
        try:
            message = self.connection.recv_bytes()
        except (EOFError, OSError) as error:
            raise self._died() from error
        if not message:
            self.has_begun = True
            return None
        returned, value = pickle.loads(message)
        return returned, value

    def is_alive(self) -> bool:
        return self._process.poll() is None

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()
        self.connection.close()

    def _died(self) -> WorkerDeath:
        self._process.kill()  # one that closed its socket is of no use either
        code = self._process.wait()
        self.connection.close()
        if code == -signal.SIGKILL:
            return WorkerDeath("its process was killed, most likely for lack of memory")
        return WorkerDeath(f"its process ended by {signal.Signals(-code).name if code < 0 else f'exit code {code}'}")


def _environment(threads: int | None) -> dict[str, str]:
    """Return the environment of a worker; variables that the user has set stay."""
    own = {} if threads is None else dict.fromkeys(_THREAD_VARIABLES, str(threads))
    return own | os.environ


class Pool:
    """A pool of at most ``size`` workers, which start on demand and are kept between runs until the pool is closed.

    Workers share the processors: each runs as many threads as there are processors for it.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._idle: list[Worker] = []

    def _new_worker(self) -> Worker:
        return Worker(max(platform.num_processors() // self.size, 1))

    @property
    def num_idle(self) -> int:
        """Number of live workers that wait for jobs."""
        for worker in [worker for worker in self._idle if not worker.is_alive()]:
            self._idle.remove(worker)
            worker.kill()
        return len(self._idle)

    def close(self) -> None:
        while self._idle:
            self._idle.pop().kill()

    def run(
        self, job: Callable[..., Any], numbered: Iterable[tuple[int, tuple[Any, ...]]]
    ) -> Iterator[tuple[int, Any]]:
        """Yield ``(index, result)`` for each ``(index, arguments)``, as in `gsmap.methods.executor.Workers.run`.

        Arguments of as many jobs as there may be workers are taken ahead, so that each worker gets a job whose scenes
        it has cached. A job that was lost with its worker is tried again when no other job runs, so that it can use all
        memory.
        """
        todo = iter(numbered)
        ahead: deque[_Task] = deque()
        again: deque[_Task] = deque()
        at: dict[Connection, tuple[Worker, _Task]] = {}
        false_starts = 0

        def lost(worker: Worker, task: _Task, died: WorkerDeath) -> bool:
            """Record a lost worker; return True if its job is to be quarantined, False if it is tried again."""
            nonlocal false_starts
            if not worker.has_begun:
                false_starts += 1
                if false_starts > _MAX_FALSE_STARTS:
                    raise GsmapError(
                        f"worker processes end before their first job: {died}", code="workers_die"
                    ) from died
                (again if task.losses else ahead).appendleft(task)
                return False
            task.losses += 1
            if task.losses < _MAX_LOSSES:
                again.append(task)
            return task.losses >= _MAX_LOSSES

        def begin_all() -> None:
            while len(at) < self.size:
                while len(ahead) < self.size and (taken := next(todo, None)) is not None:
                    ahead.append(_Task(*taken, _reads(taken[1])))
                if not ahead and (at or not again):
                    return
                worker, task = self._matched(ahead) if ahead else (self._any(), again.popleft())
                try:
                    worker.begin(job, task.arguments, task.reads)
                except WorkerDeath as died:  # while it had no job
                    worker.has_begun = False
                    lost(worker, task, died)
                except BaseException:
                    worker.kill()
                    raise
                else:
                    at[worker.connection] = worker, task

        try:
            begin_all()
            while at:
                done: list[tuple[int, Any]] = []
                raised: BaseException | None = None
                for connection in wait(list(at)):
                    assert isinstance(connection, Connection)
                    worker, task = at[connection]
                    try:
                        answer = worker.answer()
                    except WorkerDeath as died:
                        del at[connection]
                        if lost(worker, task, died):
                            done.append(
                                (task.index, QuarantinedJob(f"{died}, like the worker that had tried the job before"))
                            )
                        continue
                    if answer is None:
                        continue
                    if answer[0] is None:
                        jobs_progress.get()(task.index, *answer[1])
                        continue
                    del at[connection]
                    self._idle.append(worker)
                    false_starts = 0
                    if answer[0]:
                        done.append((task.index, answer[1]))
                    else:
                        raised = raised or answer[1]
                if raised is None:
                    begin_all()
                yield from done
                if raised is not None:
                    raise raised
        finally:
            for worker, _ in at.values():
                worker.kill()

    def _any(self) -> Worker:
        return self._idle.pop() if self.num_idle else self._new_worker()

    def _matched(self, ahead: deque[_Task]) -> tuple[Worker, _Task]:
        """Choose the idle worker and waiting job that share most input data; without an idle worker, start one."""
        if not self.num_idle:
            return self._new_worker(), ahead.popleft()
        known = [set().union(*worker.read) for worker in self._idle]
        shared = {(i, j): len(task.reads & read) for j, task in enumerate(ahead) for i, read in enumerate(known)}
        i, j = max(shared, key=shared.__getitem__)
        task = ahead[j]
        del ahead[j]
        return self._idle.pop(i), task


def _reads(arguments: tuple[Any, ...]) -> frozenset[Hashable]:
    """Return the texts and tuples among the arguments of a job, except the first argument, which is the map."""
    found = set()
    for argument in arguments[1:]:
        if isinstance(argument, (str, tuple)):
            try:
                found.add(argument)
            except TypeError:  # something within cannot be hashed
                continue
    return frozenset(found)

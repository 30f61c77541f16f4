"""Run background jobs of the page by priority, and drop jobs that are no longer requested."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from gsmap.errors import GsmapError
from gsmap.types.progress import Progress

_FORGOTTEN_S = 15.0  # age of the last request after which a job is dropped; pages ask about every second
_FAILED_S = 20.0  # delay before a failed job is tried again

Work = Callable[[Progress], object]


@dataclass(frozen=True)
class PendingResult:
    """A result that is not available yet.

    Args:
        progress: Completed fraction of its job, in [0, 1].
        waiting: Number of jobs that run before it.
    """

    progress: float
    waiting: int


@dataclass(eq=False)
class _Job:
    work: Work
    rank: float
    lasting: bool
    asked_at: float = field(default_factory=time.monotonic)
    state: str = "waiting"  # "working", "failed"
    progress: float = 0.0
    error: GsmapError | None = None


class _ShutdownRequest(Exception):
    """Raised in jobs to stop them when the maker closes."""


class Maker:
    """Threads that run named jobs, each job once, in the order of rank."""

    def __init__(self, workers: int) -> None:
        self._jobs: dict[str, _Job] = {}
        self._changed = threading.Condition()
        self._closed = False
        self._holds = 0
        self._threads = [threading.Thread(target=self._run, daemon=True) for _ in range(workers)]
        for thread in self._threads:
            thread.start()

    def ask(self, name: str, work: Work, *, rank: float = 0.0, lasting: bool = False) -> PendingResult:
        """Request a job; call this again until it returns the job's result.

        Args:
            name: Name of the job; a pending job of the same name is not started twice.
            work: Function that runs in a thread of this maker.
            rank: Jobs of lower rank run first.
            lasting: Keep the job even if it is not requested again.

        Raises:
            GsmapError: The job failed recently.
        """
        with self._changed:
            job = self._jobs.get(name)
            now = time.monotonic()
            if job is not None and job.state == "failed":
                if now - job.asked_at < _FAILED_S and job.error is not None:
                    raise job.error
                job = None
            if job is None:
                job = self._jobs[name] = _Job(work, rank, lasting)
                self._changed.notify()
            job.rank, job.lasting = min(rank, job.rank) if job.lasting else rank, job.lasting or lasting
            job.asked_at = now
            before = sum(j.state == "waiting" and j.rank < job.rank for j in self._jobs.values())
            return PendingResult(job.progress, 0 if job.state == "working" else before)

    def wait(self, done: Callable[[], bool], timeout_s: float) -> bool:
        """Wait until a condition that finished jobs change is true; return false after the timeout."""
        with self._changed:
            return self._changed.wait_for(lambda: self._closed or done(), timeout_s) and done()

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Hold the jobs, at their start and at their progress reports, while this context is open."""
        with self._changed:
            self._holds += 1
        try:
            yield
        finally:
            with self._changed:
                self._holds -= 1
                self._changed.notify_all()

    def close(self) -> None:
        """Stop the threads; running jobs end at their next progress report."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join(timeout=5)

    def _next(self) -> tuple[str, _Job] | None:
        """Return the waiting job of lowest rank, or None, after dropping jobs that are no longer requested."""
        now = time.monotonic()
        for name, job in list(self._jobs.items()):
            if job.state == "waiting" and not job.lasting and now - job.asked_at > _FORGOTTEN_S:
                del self._jobs[name]
        waiting = [(job.rank, job.asked_at, name) for name, job in self._jobs.items() if job.state == "waiting"]
        if not waiting:
            return None
        name = min(waiting)[2]
        return name, self._jobs[name]

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._closed and (self._holds or (found := self._next()) is None):
                    self._changed.wait()
                if self._closed:
                    return
                assert found is not None
                name, job = found
                job.state = "working"
            try:
                job.work(lambda fraction, text, job=job: self._report(job, fraction))  # type: ignore[misc]
            except _ShutdownRequest:
                return
            except GsmapError as error:
                job.error = error
            except Exception as error:
                job.error = GsmapError(f"{name}: {type(error).__name__} {error}", code="internal_error")
            with self._changed:
                if job.error is None:
                    self._jobs.pop(name, None)
                else:
                    job.state, job.asked_at = "failed", time.monotonic()
                self._changed.notify_all()

    def _report(self, job: _Job, fraction: float) -> None:
        if self._holds:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or not self._holds)
        if self._closed:
            raise _ShutdownRequest
        job.progress = fraction

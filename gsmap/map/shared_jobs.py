"""Share the jobs of a stage between processes: each process takes unclaimed jobs until all are done.

A job that twice ends the process it runs in is set aside: it is left out, here and in later runs, until a person asks
for it by name.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping, Sequence, Sized
from contextlib import closing, contextmanager, suppress
from typing import Any

from gsmap.engine import QuarantinedJob, is_beginning
from gsmap.errors import ConfigError, DiskError, DiskFullError, GsmapError, StoreError
from gsmap.store import Store
from gsmap.store.scenes import SceneSummary
from gsmap.types.progress import StageProgress

_log = logging.getLogger("gsmap.map")

_WORTH_S = 1.0
"""Seconds of work that are leased in one transaction. Long jobs are leased one by one, so that no job waits in one
process while another is idle; quick jobs a few at a time, so that leases cost little.
"""
_AT_MOST = 16
_PER_LEASED = 8
"""Number of leased jobs per job that is leased with the next: many workers need their next jobs soon."""

TOGETHER_S = 1.0
"""Seconds within which results of quick jobs are stored in one transaction, as each transaction costs a dozen
statements.
"""

POLL_S = 0.5
"""Seconds between checks by a waiting process whether other processes have finished or dropped jobs."""


class SharedJobs:
    """The jobs of one stage, by the keys of their results.

    Args:
        store: the store of the map.
        stage: the verb, for the lease and the progress.
        kind: ``graph``, ``edge`` or ``comparison``; a job is leased as ``KIND KEY``.
        jobs: arguments of each job by the key (digest) of its result, most important first.
        about: ids of the scenes that each job reads.
        done: returns the keys whose results are in the catalog.
        progress: receives finished jobs, and each process that is waited for once.
        again: retry quarantined jobs; else they are skipped.
    """

    def __init__(
        self,
        store: Store,
        stage: str,
        kind: str,
        jobs: Mapping[str, tuple[Any, ...]],
        about: Mapping[str, Sequence[str]],
        done: Callable[[Collection[str]], set[str]],
        progress: StageProgress,
        *,
        again: bool = False,
    ) -> None:
        self._leases, self._stage, self._kind, self._progress = store.leases, stage, kind, progress
        self._set_aside, self._about = store.quarantine, about
        self._done = done
        self._keys = list(jobs)
        self._todo = dict(jobs)  # not done as far as is known, and not begun here
        if jobs:
            self._leave_out(again)
        self._ours: list[str] = []
        self._saved: list[str] = []  # still leased
        self._came, self._began = 0, time.monotonic()

    def results(
        self, run: Callable[[Iterable[tuple[Any, ...]]], Iterator[tuple[int, Any]]]
    ) -> Generator[tuple[str, Any], None, None]:
        """Yield (key, result) of the jobs that this process runs, until all jobs are done. The caller must close the
        generator.

        Each result must be kept, and `saved` told, before the next is asked for.

        Args:
            run: does jobs by their arguments, and takes those one by one as it has room (`gsmap.engine.run_jobs`).
        """
        with closing(self.batches(run, 0.0)) as batches:
            for batch in batches:
                yield from batch

    def batches(
        self, run: Callable[[Iterable[tuple[Any, ...]]], Iterator[tuple[int, Any]]], together_s: float | None = None
    ) -> Generator[list[tuple[str, Any]], None, None]:
        """Yield results in batches of those that arrive within ``together_s`` seconds; see `results`.

        Whoever is killed loses that much work, who is interrupted or fails none.
        """
        if self._todo and is_beginning():  # its parent, who does these jobs, waits for it to have begun
            raise ConfigError(
                "a worker process would start workers again when it imports the script: put what the "
                'script does below `if __name__ == "__main__":`',
                code="main_guard_missing",
            )
        together_s = TOGETHER_S if together_s is None else together_s
        while self._todo:
            begun: list[str] = []
            batch: list[tuple[str, Any]] = []
            since = time.monotonic()
            running = run(_CountedArguments(self._begin(begun), self._todo))
            try:
                for index, result in running:
                    if isinstance(result, QuarantinedJob):
                        self._put_aside(begun[index], result.reason)
                        continue
                    self._came += 1
                    batch.append((begun[index], result))
                    if time.monotonic() - since >= together_s:
                        yield batch
                        batch, since = [], time.monotonic()
                if batch:
                    yield batch
            except GeneratorExit:
                raise
            except BaseException:
                if batch:
                    yield batch
                raise
            finally:
                if isinstance(running, Generator):
                    running.close()  # its workers end now, and not when somebody collects what is left of it
                self._leases.release([self._lease(key) for key in (*self._ours, *self._saved)])
                self._saved.clear()
            self._wait()

    def saved(self, key: str, text: str) -> None:
        """Record that the result of a job is in the catalog."""
        self._ours.remove(key)
        self._saved.append(key)
        self._tell(text)

    def _leave_out(self, again: bool) -> None:
        """Skip quarantined jobs, or release them from quarantine if they were requested again."""
        before = {one.what: one for one in self._set_aside.list()}
        known = [key for key in self._keys if self._lease(key) in before]
        if again and known:
            self._set_aside.forget([self._lease(key) for key in known])
            return
        for key in known:
            one = before[self._lease(key)]
            self._set_aside.encountered[one.what] = one
            del self._todo[key]

    def _put_aside(self, key: str, reason: str) -> None:
        about = " ".join(self._about[key])
        self._set_aside.add(self._lease(key), about, reason)
        _log.warning("%s of %s is quarantined: %s", self._kind, about, reason)
        self.saved(key, f"quarantined: {reason}")

    def num_kept(self) -> int:
        """Return the number of results in the catalog."""
        with suppress(GsmapError):
            return len(self._done(self._keys))
        return len(self._keys) - self._left

    @property
    def _left(self) -> int:
        return len(self._todo) + len(self._ours)

    def _lease(self, key: str) -> str:
        return f"{self._kind} {key}"

    def _tell(self, text: str) -> None:
        self._progress(self._stage, 1 - self._left / len(self._keys), text)

    def _begin(self, begun: list[str]) -> Iterator[tuple[Any, ...]]:
        """Lease free jobs and yield their arguments, until no job is free."""

        def done(leases: Collection[str]) -> set[str]:
            return {self._lease(key) for key in self._settled([lease.partition(" ")[2] for lease in leases])}

        while self._todo:
            worth = int(_WORTH_S * self._came / (time.monotonic() - self._began + 1e-3))
            taken = self._leases.acquire(
                [self._lease(key) for key in self._todo],
                self._stage,
                limit=min(max(worth, len(self._ours) // _PER_LEASED, 1), _AT_MOST),
                done=done,
                give_back=[self._lease(key) for key in self._saved],
            )
            self._saved.clear()
            for lease in taken.done:
                del self._todo[lease.partition(" ")[2]]
            if not taken.ours:
                return
            keys = [lease.partition(" ")[2] for lease in taken.ours]
            arguments = [self._todo.pop(key) for key in keys]
            self._ours += keys
            for key, args in zip(keys, arguments, strict=True):
                begun.append(key)
                yield args

    def _settled(self, keys: Collection[str]) -> set[str]:
        """Return the jobs that are done or were quarantined meanwhile."""
        done = self._done(keys)
        aside = {one.what for one in self._set_aside.list()}
        return done | {key for key in keys if self._lease(key) in aside}

    def _wait(self) -> None:
        """Wait until all jobs are done or a process has dropped one."""
        told: set[str] = set()
        while self._todo:
            for key in self._settled(list(self._todo)):
                del self._todo[key]
            holders = {lease.what: lease for lease in self._leases.list()}
            waited_for = [holders.get(self._lease(key)) for key in self._todo]
            if not waited_for or None in waited_for:
                return
            for holder in waited_for:
                if holder is not None and holder.token not in told:
                    told.add(holder.token)
                    self._tell(f"waiting for {holder.who}: {len(waited_for)} left")
            time.sleep(POLL_S)


class _CountedArguments:
    """An iterator over job arguments with a length hint (`operator.length_hint`)."""

    def __init__(self, arguments: Iterator[tuple[Any, ...]], left: Sized) -> None:
        self._arguments, self._left = arguments, left

    def __iter__(self) -> Iterator[tuple[Any, ...]]:
        return self._arguments

    def __length_hint__(self) -> int:
        return len(self._left)


@contextmanager
def announce_work(store: Store, task: str) -> Iterator[None]:
    """Register this process as working on the map, and log the other processes at work."""
    with store.leases.announce(task) as others:
        for other in others:
            _log.warning("%s is also running: the remaining jobs are shared", other.who)
        yield


@contextmanager
def note_interruption(kept: Callable[[], str]) -> Iterator[None]:
    """Add a note on stored results to an interruption (`BaseException.add_note`), but not to errors."""
    try:
        yield
    except BaseException as stopped:
        if not isinstance(stopped, (Exception, GeneratorExit)):
            stopped.add_note(kept())
        raise


@contextmanager
def explain_purges(store: Store, scenes: Sequence[SceneSummary]) -> Iterator[None]:
    """Raise `StoreError` in place of an error if another process has purged some of the scenes."""
    try:
        yield
    except GsmapError as error:
        left = store.scenes.names()
        gone = [scene.name for scene in scenes if scene.id not in left]
        if not gone or isinstance(error, (DiskError, DiskFullError)):
            raise
        raise StoreError(
            f"another process purged {', '.join(gone[:3])} meanwhile: run the same command again",
            code="changed_meanwhile",
        ) from error

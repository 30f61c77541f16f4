"""An executor for a running Dask cluster, which is found by the address of its scheduler.

The scheduler holds little work and few results: jobs are submitted as workers are free, and each compressed result is
fetched at once and committed to the map's catalog. So any part of the cluster may end.
"""

from __future__ import annotations

import logging
import math
import os
import pickle
import queue
import time
import uuid
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from gsmap.engine.worker import answer
from gsmap.errors import ConfigError, GsmapError, MissingDependencyError, NotFoundError
from gsmap.methods.executor import QuarantinedJob
from gsmap.settings.ranges import require_range
from gsmap.version import __version__

VERSION = 1

_ATTEMPTS = 2
"""Number of attempts after which a job that never ended is quarantined, as it probably killed its workers."""

_BEGUN = "gsmap-begun"  # metadata key of the number of attempts
_POLL_S = 1.0  # interval at which the number of workers is read
_WARN_AFTER_S = 10.0  # time without workers after which a warning is logged
_AHEAD = 0.25  # jobs submitted beyond one for each thread of the workers, as a fraction of these
_MIN_SUBMITTED = 4  # jobs submitted however few workers there are, so that a cluster that grows on demand sees some
_log = logging.getLogger("gsmap.engine")


@dataclass(frozen=True)
class Params:
    """Settings of the Dask executor.

    Args:
        scheduler: Address of the Dask scheduler, such as ``tcp://host:8786``; if empty, the environment variable
            ``GSMAP_SCHEDULER`` is used.
        timeout_s: Longest time in seconds, positive, to wait for the scheduler before a run fails; larger tolerates
            slower networks.
    """

    scheduler: str = ""
    timeout_s: float = 30.0

    def __post_init__(self) -> None:
        require_range(self, "(0, inf]", "timeout_s")


class DaskWorkers:
    """Workers of a Dask cluster; see `gsmap.methods.executor.Workers`."""

    def __init__(self, address: str, params: Params) -> None:
        self._address, self._params = address, params
        self._client: Any = None
        self._alone_since: float | None = None  # time at which the cluster was first seen without workers
        self._warned = False

    def run(
        self, job: Callable[..., Any], arguments: Iterable[tuple[Any, ...]], *, quick: bool = False
    ) -> Iterator[tuple[int, Any]]:
        todo = enumerate(arguments)
        taken = next(todo, None)
        if taken is None:
            return
        client, run = self._connected(), uuid.uuid4().hex
        done: queue.SimpleQueue[Any] = queue.SimpleQueue()
        running: dict[Any, tuple[int, bytes]] = {}

        def submit(index: int, message: bytes) -> None:
            key = f"gsmap-{run}-{index}"
            future = client.submit(do, run, key, message, __version__, key=f"{key}-{uuid.uuid4().hex[:8]}", pure=False)
            running[future] = index, message
            future.add_done_callback(done.put)

        try:
            room, looked = self._room(), time.monotonic()
            while running or taken is not None:
                while taken is not None and len(running) < room:
                    submit(taken[0], pickle.dumps((job, taken[1]), pickle.HIGHEST_PROTOCOL))
                    taken = next(todo, None)
                try:
                    future = done.get(timeout=_POLL_S)
                except queue.Empty:
                    future = None
                if time.monotonic() - looked > _POLL_S:
                    room, looked = self._room(), time.monotonic()
                if future is None:
                    continue
                index, message = running.pop(future)
                result = self._result(future)
                if result is None:  # the scheduler forgot it
                    submit(index, message)
                    continue
                returned, value = result
                if not returned:
                    raise self._explained(value)
                yield index, value
        finally:
            self._forget(run, list(running))

    def close(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            client.close()

    def _connected(self) -> Any:
        if self._client is None:
            try:
                from distributed import Client
            except ImportError as error:
                raise MissingDependencyError(
                    "the dask executor needs the package distributed", extra="cluster"
                ) from error
            try:
                self._client = Client(self._address, timeout=self._params.timeout_s, set_as_default=False, name="gsmap")
            except (OSError, ValueError, TimeoutError) as error:
                raise GsmapError(
                    f"cannot connect to the Dask scheduler at {self._address}: {error}",
                    code="scheduler_unreachable",
                ) from error
        return self._client

    def _room(self) -> int:
        """Return the number of jobs that may be submitted at once."""
        try:
            threads = sum(self._client.nthreads().values())
        except Exception as error:  # a lost connection may raise anything
            raise self._lost() from error
        self._warn_of_no_workers(threads)
        return max(threads + math.ceil(_AHEAD * threads), _MIN_SUBMITTED)

    def _warn_of_no_workers(self, threads: int) -> None:
        """Log one warning after the cluster has had no workers for some time."""
        if threads:
            self._alone_since, self._warned = None, False
            return
        now = time.monotonic()
        self._alone_since = now if self._alone_since is None else self._alone_since
        if not self._warned and now - self._alone_since >= _WARN_AFTER_S:
            self._warned = True
            _log.warning("waiting for workers of %s; each needs gsmap %s", self._address, __version__)

    def _explained(self, error: BaseException) -> BaseException:
        """Return the error of a job, or the cause of an error that would mislead on this machine."""
        if getattr(error, "code", None) != "map_not_found":
            return error
        explained = NotFoundError(
            f"a worker of {self._address} cannot see the map: mount it there under the same path, or set the same "
            f"variables (AWS_...) for an object store ({error})",
            code="map_not_on_worker",
        )
        explained.__cause__ = error
        return explained

    def _result(self, future: Any) -> tuple[bool, Any] | None:
        """Return (True, value) or (False, error) of a job; None if the job must be submitted again.

        Raises:
            GsmapError: the scheduler is gone.
        """
        from distributed import CancelledError, KilledWorker

        try:
            packed = future.result(timeout=self._params.timeout_s)
        except KilledWorker as error:
            return True, QuarantinedJob(
                f"the workers that tried the job died, most likely for lack of memory ({error})"
            )
        except (CancelledError, TimeoutError) as error:
            if self._client is None or self._client.status != "running":
                raise self._lost() from error
            return None
        except (ImportError, pickle.UnpicklingError, TypeError) as error:  # TypeError: another signature of `do`
            raise GsmapError(
                f"a worker of {self._address} could not load its job ({error}): install the same version of gsmap "
                "there",
                code="worker_mismatch",
            ) from error
        returned, value = pickle.loads(zlib.decompress(packed))
        return returned, value

    def _lost(self) -> GsmapError:
        self._client = None
        return GsmapError(
            f"the Dask scheduler at {self._address} was lost; finished results are kept: run the same command again",
            code="scheduler_lost",
        )

    def _forget(self, run: str, futures: list[Any]) -> None:
        client = self._client
        if client is None or client.status != "running":
            return
        if futures:
            client.cancel(futures, force=True)
        client.set_metadata([_BEGUN, run], {})


def start(params: Params) -> DaskWorkers:
    address = params.scheduler or os.environ.get("GSMAP_SCHEDULER", "")
    if not address:
        raise ConfigError(
            "the dask executor needs the address of its scheduler: pass --scheduler tcp://HOST:8786, or set the "
            "environment variable GSMAP_SCHEDULER",
            code="missing_option",
        )
    return DaskWorkers(address, params)


def do(run: str, key: str, message: bytes, version: str) -> bytes:
    """Run a job on a worker and return its compressed result; do not run a job that killed its workers twice.

    Args:
        version: version of gsmap that submitted the job; the result is an error if the worker has another one, whose
            results would differ.
    """
    from distributed import get_worker
    from distributed.utils import sync

    worker = get_worker()

    def packed(returned: bool, value: Any) -> bytes:
        return zlib.compress(pickle.dumps((returned, value)), 1)

    if version != __version__:
        mismatch = GsmapError(
            f"the Dask worker at {worker.address} has gsmap {__version__}, but this is gsmap {version}: install the "
            "same version there",
            code="worker_mismatch",
        )
        return packed(False, mismatch)

    def begun(times: int | None = None) -> int:
        """Return the job's number of attempts from the scheduler, or set it to ``times``."""
        keys = [_BEGUN, run, key]
        if times is None:
            found: int = sync(worker.loop, worker.scheduler.get_metadata, keys=keys, default=0)
            return found
        sync(worker.loop, worker.scheduler.set_metadata, keys=keys, value=times)
        return times

    before = begun()
    if before >= _ATTEMPTS:
        reason = f"{before} workers that tried the job died, most likely for lack of memory"
        return packed(True, QuarantinedJob(reason))
    begun(before + 1)
    result = zlib.compress(answer(message), 1)
    begun(0)  # losses from now on do not count as attempts
    return result

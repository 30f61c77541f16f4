"""Leases in the storage of a backup, of processes that save and of the process that deletes unneeded objects.

Every process first writes its lease and then reads those of the others. So if a saver and a sweeper start at the same
time, at least one sees the other: a saver waits for the sweeper to end, and a sweeper gives up without deleting
anything. A lease expires if it is not renewed in time, or if its process on this machine has ended; ages are by the
clock of the storage, never by the local one.
"""

from __future__ import annotations

import contextlib
import json
import threading
import time
import uuid
from dataclasses import asdict
from types import TracebackType

from gsmap.errors import MALFORMED, BusyError, GsmapError, NotFoundError, StoreError
from gsmap.store.storage import Storage
from gsmap.types.lock_owner import LockOwner, this_process

LEASES = "leases/"
SAVE = "save"
SWEEP = "sweep"
RENEW_S = 60.0
EXPIRES_S = 900.0  # a writer that cannot renew for so long has stopped, or stops in `require`
PATIENCE_S = 1800.0  # maximum wait of a saver for a sweeper, longer than a dead one's lease lasts
_MAX_BYTES = 10_000  # of a lease


class BackupLease:
    """A lease in the storage of a backup, renewed by a thread until the block is left.

    Args:
        task: `SAVE` or `SWEEP`.
    """

    def __init__(self, storage: Storage, task: str) -> None:
        self.name = f"{LEASES}{task}-{uuid.uuid4().hex}.json"
        self._storage = storage
        self._holder = this_process(f"backup {task}")
        self._renewed = 0.0
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._keep, name=self.name, daemon=True)

    def __enter__(self) -> BackupLease:
        self._renew()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._done.set()
        self._thread.join()
        with contextlib.suppress(GsmapError):  # otherwise it expires
            self._storage.delete(self.name)

    def require(self) -> None:
        """Raise an error unless the lease was renewed recently, so that other processes can rely on it.

        Raises:
            StoreError: the lease could not be renewed, or this process was suspended for long.
        """
        if time.monotonic() - self._renewed > EXPIRES_S / 2:
            raise StoreError(
                f"{self._storage.url} could not be reached for {EXPIRES_S / 2:g} s: run the same command again",
                code="storage_failed",
            )

    def others(self, task: str = "") -> list[str]:
        """Return the names of the valid leases of other processes, for one task or for all tasks."""
        listed = self._storage.list(LEASES)
        if self.name not in listed:
            raise StoreError(
                f"{self._storage.url}: another process took over the expired lease: run the same command again",
                code="lease_lost",
            )
        oldest = listed[self.name].modified_s - EXPIRES_S
        del listed[self.name]
        wanted = {name: about for name, about in listed.items() if name.startswith(LEASES + task)}
        return [
            name
            for name, about in wanted.items()
            if about.modified_s >= oldest and not (about.size_bytes <= _MAX_BYTES and self._is_gone(name))
        ]

    def _is_gone(self, name: str) -> bool:
        """Return True if the owner of a lease ran on this machine and has ended; then deletes the lease."""
        try:
            content = json.loads(b"".join(self._storage.get(name)))
            gone = LockOwner(**{key: str(content[key]) for key in ("task", "host", "process", "since")}).is_gone
        except NotFoundError:
            return True
        except MALFORMED:
            return False
        if gone:
            self._storage.delete(name)
        return gone

    def wait_for_sweepers(self) -> None:
        """Wait until no process is deleting old snapshots and objects.

        Raises:
            BusyError: a process is still deleting after a long time.
        """
        deadline, pause = time.monotonic() + PATIENCE_S, 0.05
        while self.others(SWEEP):
            if time.monotonic() > deadline:
                raise BusyError(
                    f"{self._storage.url}: another gsmap process is deleting old snapshots there: try again later",
                    code="backup_busy",
                )
            time.sleep(pause)
            pause = min(2 * pause, 5.0)
            self.require()

    def _renew(self) -> None:
        began = time.monotonic()
        text = json.dumps(asdict(self._holder)).encode()
        self._storage.put(self.name, [text], len(text))
        self._renewed = began

    def _keep(self) -> None:
        while not self._done.wait(RENEW_S):
            with contextlib.suppress(GsmapError):  # `require` raises
                self._renew()

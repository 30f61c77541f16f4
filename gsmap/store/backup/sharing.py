"""Who is at work in a backup: those who save, and the one who deletes what is not needed.

Everybody first says that he is there and then looks who else is. So of a saver and a sweeper that come at the same time
at least one sees the other: a saver waits for the sweeper to be done, and a sweeper goes away and leaves everything as
it is. A lease that is not renewed in time is nobody's, and one of a process of this machine that has ended; ages are by
the clock of the place, never by ours.
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
from gsmap.store.places import Place
from gsmap.types.lock_owner import LockOwner, this_process

LEASES = "leases/"
SAVE = "save"
SWEEP = "sweep"
RENEW_S = 60.0
EXPIRES_S = 900.0  # a writer whose place did not answer for so long has stopped, or stops when it notices
PATIENCE_S = 1800.0  # a saver waits so long for a sweeper; longer than a dead one's lease lives
_MAX_BYTES = 10_000  # of a lease


class Lease:
    """A sign in the place that somebody is at work; renewed by a thread until it is left.

    Args:
        task: `SAVE` or `SWEEP`.
    """

    def __init__(self, place: Place, task: str) -> None:
        self.name = f"{LEASES}{task}-{uuid.uuid4().hex}.json"
        self._place = place
        self._holder = this_process(f"backup {task}")
        self._renewed = 0.0
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._keep, name=self.name, daemon=True)

    def __enter__(self) -> Lease:
        self._renew()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._done.set()
        self._thread.join()
        with contextlib.suppress(GsmapError):  # it expires
            self._place.delete(self.name)

    def require(self) -> None:
        """Go on only while others can know that we are here.

        Raises:
            StoreError: the lease could not be renewed, or this process stood still for long.
        """
        if time.monotonic() - self._renewed > EXPIRES_S / 2:
            raise StoreError(
                f"{self._place.url} could not be reached for {EXPIRES_S / 2:g} s: run it again", code="place_failed"
            )

    def others(self, task: str = "") -> list[str]:
        """Names of the leases of others that still count, of one task or of all."""
        listed = self._place.list(LEASES)
        if self.name not in listed:
            raise StoreError(f"{self._place.url}: our lease was taken away; run it again", code="lease_lost")
        oldest = listed[self.name].modified_s - EXPIRES_S
        del listed[self.name]
        wanted = {name: about for name, about in listed.items() if name.startswith(LEASES + task)}
        return [
            name
            for name, about in wanted.items()
            if about.modified_s >= oldest and not (about.size_bytes <= _MAX_BYTES and self._is_gone(name))
        ]

    def _is_gone(self, name: str) -> bool:
        """Whether who wrote a lease has ended, as far as this machine can tell; the lease goes with it then."""
        try:
            told = json.loads(b"".join(self._place.get(name)))
            gone = LockOwner(**{key: str(told[key]) for key in ("task", "host", "process", "since")}).is_gone
        except NotFoundError:
            return True
        except MALFORMED:
            return False
        if gone:
            self._place.delete(name)
        return gone

    def wait_for_sweepers(self) -> None:
        """Return when nobody deletes.

        Raises:
            BusyError: somebody still does after a long time.
        """
        deadline, pause = time.monotonic() + PATIENCE_S, 0.05
        while self.others(SWEEP):
            if time.monotonic() > deadline:
                raise BusyError(
                    f"{self._place.url}: another gsmap is deleting old snapshots there; try again later",
                    code="backup_busy",
                )
            time.sleep(pause)
            pause = min(2 * pause, 5.0)
            self.require()

    def _renew(self) -> None:
        began = time.monotonic()
        text = json.dumps(asdict(self._holder)).encode()
        self._place.put(self.name, [text], len(text))
        self._renewed = began

    def _keep(self) -> None:
        while not self._done.wait(RENEW_S):
            with contextlib.suppress(GsmapError):  # `require` tells
                self._renew()

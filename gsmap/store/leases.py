"""Time-limited leases of processes on a map, its jobs, or export folders.

A lease keeps two processes from doing the same work. It guards no data: every write is a transaction that is valid
whichever process makes it. So a lost lease (a machine that was suspended) costs duplicate work and nothing else, and
leases favour speed over certainty.
"""

from __future__ import annotations

import logging
import threading
import uuid
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from itertools import islice
from typing import Any

from sqlalchemy import ColumnElement, Connection, delete, func, select, update
from sqlalchemy.dialects import sqlite as sqlite_dialect

from gsmap.errors import BusyError, GsmapError, StoreError
from gsmap.store.catalog import Catalog
from gsmap.store.error_translation import display_name
from gsmap.store.schema import leases
from gsmap.types.lock_owner import LockOwner, this_process

_log = logging.getLogger("gsmap.leases")

LEASE_S = 60.0
"""Seconds after which a lease expires unless it is renewed, and others may take over the work of a dead machine. The
end of a process on this machine is noticed at once.
"""

HEARTBEAT_S = 15.0
"""Seconds between renewals of all leases of a process, in one small transaction. Three renewals may fail (a long
writer, a server restart) before a lease expires.
"""

_AT_ONCE = 1000  # rows in one statement, within the limits on bound values
_PATIENCE_S = 1.0  # wait for the writer lock to release leases; unreleased ones expire


@dataclass(frozen=True)
class Lease(LockOwner):
    """A time-limited right of a process to some work.

    Args:
        what: ``map``, ``poses``, ``graph KEY``, ``edge KEY`` or ``export FOLDER``.
        token: of its owner, an open `gsmap.store.Store`.
        expires_at: when it expires unless it is renewed, ISO 8601, UTC.
    """

    what: str
    token: str
    expires_at: str


@dataclass(frozen=True)
class AcquiredLeases:
    """Result of `Leases.acquire`.

    Args:
        ours: work leased to this process.
        done: work that is done already.
    """

    ours: tuple[str, ...]
    done: frozenset[str]


class Leases:
    """The leases of a map. One thread renews all leases of an open store.

    Times are by one clock: that of the catalog's server, or of the machine for a catalog file (SQLite's write-ahead log
    requires that its users are on one machine). So clock differences between machines do not matter.
    """

    def __init__(self, catalog: Catalog, *, lease_s: float = LEASE_S, heartbeat_s: float = HEARTBEAT_S) -> None:
        self._catalog = catalog
        self._lease_s = lease_s
        self._heartbeat_s = heartbeat_s
        self._token = uuid.uuid4().hex
        self._lock = threading.Lock()
        self._held: set[str] = set()
        self._present: dict[str, int] = {}
        self._verb = ""  # announced task, of which the jobs of this process are part
        self._heartbeat: _Heartbeat | None = None

    def others(self) -> list[Lease]:
        """Return the leases of other processes."""
        return [lease for lease in self.list() if lease.token != self._token]

    @contextmanager
    def announce(self, task: str, what: str = "map") -> Iterator[list[Lease]]:
        """Announce work of this process that does not exclude other processes; yield their leases on the same work.

        Announces nothing for a map that was opened for reading.
        """
        if not self._catalog.writable:
            yield self.others()
            return
        mine = f"{what} #{self._token}"
        with self._lock:
            self._present[mine] = self._present.get(mine, 0) + 1
            is_first = self._present[mine] == 1
            self._verb = self._verb or task
        try:
            if is_first:
                try:
                    self.acquire([mine], task)
                except StoreError as error:  # a full disk: the work itself may not need to write here
                    _log.info("the lease could not be saved, so other processes may do the same work: %s", error)
            yield [lease for lease in self.others() if lease.what == what]
        finally:
            with self._lock:
                self._present[mine] -= 1
                is_last = not self._present[mine]
                if not any(self._present.values()):
                    self._verb = ""
            if is_last:
                self.release([mine])

    @contextmanager
    def hold(self, what: str, task: str) -> Iterator[None]:
        """Hold an exclusive lease on some work.

        Raises:
            BusyError: another process holds it; the message has its name and start time.
        """
        if not self.try_hold(what, task):
            holder = next((lease for lease in self.list() if lease.what == what), None)
            owner = "another process" if holder is None else holder.who
            raise BusyError(
                f"{display_name(self._catalog.folder)}: {owner} is working on {what}: try again when it has finished",
                code="lease_held",
            )
        try:
            yield
        finally:
            self.release([what])

    def try_hold(self, what: str, task: str) -> bool:
        """Try to get an exclusive lease, which `release` gives back; return False if another process has it."""
        return bool(self.acquire([what], task).ours)

    def acquire(
        self,
        work: Iterable[str],
        task: str,
        *,
        limit: int | None = None,
        done: Callable[[Collection[str]], Collection[str]] | None = None,
        give_back: Collection[str] = (),
    ) -> AcquiredLeases:
        """Acquire leases on work that no other process has leased, in one transaction.

        Args:
            work: what to lease, most wanted first.
            limit: maximum number of leases; default: all.
            done: returns those of some free work that are done already; called within the transaction, so that no other
                process can do and release work in between.
            give_back: leases to release.
        """
        with self._catalog.write() as connection:
            now = self._now(connection)
            if give_back:
                connection.execute(delete(leases).where(self._mine(give_back)))
            living, gone = self._split_by_validity(connection, now)
            for lease in gone:  # only if unchanged: its owner may have renewed it
                same = (leases.c.what == lease.what) & (leases.c.token == lease.token)
                connection.execute(delete(leases).where(same, leases.c.expires_at == lease.expires_at))
            held = {lease.what for lease in living}
            free = (what for what in work if what not in held)
            ours: list[str] = []
            finished: set[str] = set()
            while batch := list(islice(free, None if limit is None else limit - len(ours))):
                found = set(done(batch)) if done is not None else set()
                finished |= found
                ours += [what for what in batch if what not in found]
            ours = self._insert(connection, ours, task, now)
        with self._lock:
            self._held = (self._held - set(give_back)) | set(ours)
            if self._held and self._heartbeat is None:
                self._heartbeat = _Heartbeat(self._renew, self._heartbeat_s)
        return AcquiredLeases(tuple(ours), frozenset(finished))

    def release(self, work: Collection[str]) -> None:
        """Release leases of this store; a lease that cannot be released now (a full disk) expires by itself."""
        with self._lock:
            mine = self._held & set(work)
            self._held -= mine
            idle, self._heartbeat = (None, self._heartbeat) if self._held else (self._heartbeat, None)
        if idle is not None:
            idle.end()
        if mine:
            with suppress(GsmapError), self._catalog.lock(_PATIENCE_S), self._catalog.write() as connection:
                connection.execute(delete(leases).where(self._mine(mine)))

    def close(self) -> None:
        """Release all leases."""
        self.release(tuple(self._held))

    def _renew(self) -> None:
        with self._lock:
            held = set(self._held)
        with self._catalog.lock(self._heartbeat_s), self._catalog.write() as connection:
            until = _text(self._now(connection) + timedelta(seconds=self._lease_s))
            renewed = connection.execute(update(leases).where(self._mine(held)).values(expires_at=until))
        if renewed.rowcount < len(held):
            _log.info(
                "%d leases of this process had expired: other processes may do the same work",
                len(held) - renewed.rowcount,
            )

    def _insert(self, connection: Connection, work: list[str], task: str, now: datetime) -> list[str]:
        """Insert leases; return the leases that no process on another machine inserted at the same moment."""
        me = this_process(self._verb or task)
        row = {
            "token": self._token,
            "host": me.host,
            "process": me.process,
            "task": me.task,
            "since": _text(now),
            "expires_at": _text(now + timedelta(seconds=self._lease_s)),
        }
        insert: Any = sqlite_dialect.insert
        if not self._catalog.is_sqlite:
            from sqlalchemy.dialects import postgresql  # 20 modules that the other maps do without

            insert = postgresql.insert
        # Sorted, so that concurrent inserts on a server cannot deadlock.
        ordered, ours = [{"what": what, **row} for what in sorted(work)], set[str]()
        for start in range(0, len(ordered), _AT_ONCE):
            some = insert(leases).values(ordered[start : start + _AT_ONCE])
            ours |= set(connection.execute(some.on_conflict_do_nothing().returning(leases.c.what)).scalars())
        return [what for what in work if what in ours]

    def _split_by_validity(self, connection: Connection, now: datetime) -> tuple[list[Lease], list[Lease]]:
        """Return the valid leases and the expired leases."""
        columns = ("task", "host", "process", "since", "what", "token", "expires_at")
        rows = connection.execute(select(leases).order_by(leases.c.since, leases.c.what))
        found = [Lease(*(str(getattr(row, column)) for column in columns)) for row in rows]
        # A later expiry is invalid: the clock was set back, or gsmap did not write it.
        latest = _text(now + timedelta(seconds=2 * self._lease_s))
        ended = {one.process: one.is_gone for one in {lease.process: lease for lease in found}.values()}
        at = _text(now)
        holds = [at < lease.expires_at <= latest and not ended[lease.process] for lease in found]
        living = [lease for lease, yes in zip(found, holds, strict=True) if yes]
        return living, [lease for lease, yes in zip(found, holds, strict=True) if not yes]

    def _mine(self, work: Collection[str]) -> ColumnElement[bool]:
        return (leases.c.token == self._token) & leases.c.what.in_(sorted(work))

    def _now(self, connection: Connection) -> datetime:
        """Return the time of the clock that all processes of the map share."""
        if self._catalog.is_sqlite:
            return datetime.now(UTC)
        found: datetime = connection.execute(select(func.clock_timestamp())).scalar_one()
        return found.astimezone(UTC)

    def list(self) -> list[Lease]:
        """Return all leases, including those of this process, oldest first; writes nothing."""
        with self._catalog.read() as connection:
            living, _ = self._split_by_validity(connection, self._now(connection))
        return [replace(lease, what=_without_token(lease.what)) for lease in living]


class _Heartbeat:
    """A thread that calls a function at a fixed interval and ignores its errors."""

    def __init__(self, do: Callable[[], None], every_s: float) -> None:
        self._do, self._every_s = do, every_s
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="gsmap-leases", daemon=True)
        self._thread.start()

    def end(self) -> None:
        self._ended.set()
        self._thread.join(_PATIENCE_S)

    def _run(self) -> None:
        while not self._ended.wait(self._every_s):
            try:
                self._do()
            except Exception as error:  # a full disk, a server restart, a store being closed
                _log.info("the leases could not be renewed; the next attempt is in %g s: %s", self._every_s, error)


def _text(time: datetime) -> str:
    return time.isoformat(timespec="microseconds")


def _without_token(what: str) -> str:
    """Strip the token that distinguishes announcements of the same work."""
    return what.partition(" #")[0]

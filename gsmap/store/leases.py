"""Who is at work on a map, on one of its jobs, or on a folder it is exported to, and until when that can be relied on.

A lease says who does something, so that others do something else meanwhile. It guards no data: every write is a
transaction that is right whoever makes it. So a lease that is lost (a machine that slept) costs work done twice and
nothing else, and nothing here has to be certain where that would be slow.
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

from sqlalchemy import ColumnElement, Connection, delete, func, select, update
from sqlalchemy.dialects import postgresql
from sqlalchemy.dialects import sqlite as sqlite_dialect

from gsmap.errors import BusyError, GsmapError, StoreError
from gsmap.store.catalog import Catalog
from gsmap.store.explained import called
from gsmap.store.schema import leases
from gsmap.types.lock_owner import LockOwner, this_process

_log = logging.getLogger("gsmap.leases")

LEASE_S = 60.0
"""How long a lease holds unless it is renewed: how long the work of a machine that died stays undone. Processes of this
machine are seen to end at once."""

HEARTBEAT_S = 15.0
"""How often a process renews what it holds, in one small transaction: three may fail (a writer that keeps the lock, a
server that restarts) before anything is lost."""

_AT_ONCE = 1000  # rows in one statement: a database takes some ten thousand values
_PATIENCE_S = 1.0  # for the writer lock, to give leases back: who ends must not wait, and what stays runs out


@dataclass(frozen=True)
class Lease(LockOwner):
    """What a process is at work on.

    Args:
        what: ``map``, ``poses``, ``graph KEY``, ``edge KEY`` or ``export FOLDER``.
        token: of its holder, an open `gsmap.store.Store`.
        expires_at: until when it holds unless it is renewed, ISO 8601, UTC.
    """

    what: str
    token: str
    expires_at: str


@dataclass(frozen=True)
class Taken:
    """What `Leases.take` found.

    Args:
        ours: leased to this process now.
        done: needs no doing any more.
    """

    ours: tuple[str, ...]
    done: frozenset[str]


class Leases:
    """The leases of a map. All that one open store holds are renewed by one thread, for as long as it holds any.

    Times are by one clock: that of the catalog's server, or of the machine where the catalog is a file (SQLite's write
    log needs its users on one machine). So clocks that differ between machines make no difference.
    """

    def __init__(self, catalog: Catalog, *, lease_s: float = LEASE_S, heartbeat_s: float = HEARTBEAT_S) -> None:
        self._catalog = catalog
        self._lease_s = lease_s
        self._heartbeat_s = heartbeat_s
        self._token = uuid.uuid4().hex
        self._lock = threading.Lock()
        self._held: set[str] = set()
        self._present: dict[str, int] = {}
        self._verb = ""  # what this process said it is at work on: its jobs are part of that
        self._beat: _Beat | None = None

    def others(self) -> list[Lease]:
        """As `list`, without what this store holds itself."""
        return [lease for lease in self.list() if lease.token != self._token]

    @contextmanager
    def attend(self, task: str, what: str = "map") -> Iterator[list[Lease]]:
        """Say that this process is at work on something, which others may be, too; yields who else is.

        A map that was opened for reading is not told.
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
                    self.take([mine], task)
                except StoreError as error:  # a full disk: what is to be done may need nothing written here
                    _log.info("others are not told that this process is at work: %s", error)
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
        """Be the only one at work on something.

        Raises:
            BusyError: somebody else is; the message says who and since when.
        """
        if not self.try_hold(what, task):
            holder = next((lease for lease in self.list() if lease.what == what), None)
            who = "another process" if holder is None else holder.who
            raise BusyError(
                f"{called(self._catalog.folder)}: {who} is at work on {what}; try again when it has ended",
                code="lease_held",
            )
        try:
            yield
        finally:
            self.release([what])

    def try_hold(self, what: str, task: str) -> bool:
        """Whether this process is the only one at work on something from now on, until `release`."""
        return bool(self.take([what], task).ours)

    def take(
        self,
        whats: Iterable[str],
        task: str,
        *,
        limit: int | None = None,
        done: Callable[[Collection[str]], Collection[str]] | None = None,
        give_back: Collection[str] = (),
    ) -> Taken:
        """Lease what nobody is at work on, in one transaction.

        Args:
            whats: what to lease, the most wanted first.
            limit: at most so many; all by default.
            done: tells which of those that nobody is at work on need no doing; called within the transaction, so that
                nobody can have done and given back one in between.
            give_back: what is held and no longer needed.
        """
        with self._catalog.write() as connection:
            now = self._now(connection)
            if give_back:
                connection.execute(delete(leases).where(self._mine(give_back)))
            living, gone = self._judged(connection, now)
            for lease in gone:  # as it was when it was judged: its holder may have come back
                same = (leases.c.what == lease.what) & (leases.c.token == lease.token)
                connection.execute(delete(leases).where(same, leases.c.expires_at == lease.expires_at))
            held = {lease.what for lease in living}
            free = (what for what in whats if what not in held)
            ours: list[str] = []
            finished: set[str] = set()
            while batch := list(islice(free, None if limit is None else limit - len(ours))):
                found = set(done(batch)) if done is not None else set()
                finished |= found
                ours += [what for what in batch if what not in found]
            ours = self._insert(connection, ours, task, now)
        with self._lock:
            self._held = (self._held - set(give_back)) | set(ours)
            if self._held and self._beat is None:
                self._beat = _Beat(self._renew, self._heartbeat_s)
        return Taken(tuple(ours), frozenset(finished))

    def release(self, whats: Collection[str]) -> None:
        """Give back what this store holds of these; what cannot be given back now (a full disk) runs out by itself."""
        with self._lock:
            mine = self._held & set(whats)
            self._held -= mine
            idle, self._beat = (None, self._beat) if self._held else (self._beat, None)
        if idle is not None:
            idle.end()
        if mine:
            with suppress(GsmapError), self._catalog.lock(_PATIENCE_S), self._catalog.write() as connection:
                connection.execute(delete(leases).where(self._mine(mine)))

    def close(self) -> None:
        """Give back everything."""
        self.release(tuple(self._held))

    def _renew(self) -> None:
        with self._lock:
            held = set(self._held)
        with self._catalog.lock(self._heartbeat_s), self._catalog.write() as connection:
            until = _text(self._now(connection) + timedelta(seconds=self._lease_s))
            renewed = connection.execute(update(leases).where(self._mine(held)).values(expires_at=until))
        if renewed.rowcount < len(held):
            _log.info("%d leases had run out: others may do the same work", len(held) - renewed.rowcount)

    def _insert(self, connection: Connection, whats: list[str], task: str, now: datetime) -> list[str]:
        """Those of them that nobody on another machine leased in this moment."""
        me = this_process(self._verb or task)
        row = {
            "token": self._token,
            "host": me.host,
            "process": me.process,
            "task": me.task,
            "since": _text(now),
            "expires_at": _text(now + timedelta(seconds=self._lease_s)),
        }
        insert = sqlite_dialect.insert if self._catalog.is_sqlite else postgresql.insert
        # In one order for all, or two servers' connections wait for each other.
        ordered, ours = [{"what": what, **row} for what in sorted(whats)], set[str]()
        for start in range(0, len(ordered), _AT_ONCE):
            some = insert(leases).values(ordered[start : start + _AT_ONCE])
            ours |= set(connection.execute(some.on_conflict_do_nothing().returning(leases.c.what)).scalars())
        return [what for what in whats if what in ours]

    def _judged(self, connection: Connection, now: datetime) -> tuple[list[Lease], list[Lease]]:
        """The leases that hold, and those that do not."""
        columns = ("task", "host", "process", "since", "what", "token", "expires_at")
        rows = connection.execute(select(leases).order_by(leases.c.since, leases.c.what))
        found = [Lease(*(str(getattr(row, column)) for column in columns)) for row in rows]
        # Longer than one can be leased for: the clock was set back, or somebody else wrote it.
        latest = _text(now + timedelta(seconds=2 * self._lease_s))
        holds = [_text(now) < lease.expires_at <= latest and not lease.is_gone for lease in found]
        living = [lease for lease, yes in zip(found, holds, strict=True) if yes]
        return living, [lease for lease, yes in zip(found, holds, strict=True) if not yes]

    def _mine(self, whats: Collection[str]) -> ColumnElement[bool]:
        return (leases.c.token == self._token) & leases.c.what.in_(sorted(whats))

    def _now(self, connection: Connection) -> datetime:
        """By the one clock."""
        if self._catalog.is_sqlite:
            return datetime.now(UTC)
        found: datetime = connection.execute(select(func.clock_timestamp())).scalar_one()
        return found.astimezone(UTC)

    def list(self) -> list[Lease]:
        """Everything that somebody is at work on, this process included, oldest first. Nothing is written."""
        with self._catalog.read() as connection:
            living, _ = self._judged(connection, self._now(connection))
        return [replace(lease, what=_named(lease.what)) for lease in living]


class _Beat:
    """A thread that does something every so many seconds, and goes on whatever that says."""

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
            except Exception as error:  # a full disk, a server that restarts, a store that is being closed
                _log.info("leases were not renewed, which is tried again in %g s: %s", self._every_s, error)


def _text(time: datetime) -> str:
    return time.isoformat(timespec="microseconds")


def _named(what: str) -> str:
    """Without what tells several that attend the same from each other."""
    return what.partition(" #")[0]

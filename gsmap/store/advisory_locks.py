"""Locks of a PostgreSQL server, which replace file locks for a catalog on a server; one database holds one map.

Each lock belongs to a transaction: the server frees it when the transaction or its connection ends.
"""

from __future__ import annotations

from sqlalchemy import Connection, text
from sqlalchemy.exc import OperationalError

from gsmap.errors import BusyError

WRITER, ARRAYS = 1, 2
_NAMESPACE = 0x67736D70  # "gsmp": the namespace of gsmap's locks, apart from those of other programs
_NOT_AVAILABLE = "55P03"


def acquire(connection: Connection, lock: int, patience_s: float, busy: str, *, shared: bool = False) -> None:
    """Take a lock until the end of the connection's transaction.

    Args:
        lock: `WRITER` or `ARRAYS`.
        busy: description of what other processes are doing, for the error message.
        shared: take a shared lock.

    Raises:
        BusyError: another process kept the lock for ``patience_s``.
    """
    kind, number = "_shared" if shared else "", {"a": _NAMESPACE, "b": lock}
    later = f"{busy} for {patience_s:g} s; try again later"
    if patience_s <= 0:
        if not connection.execute(text(f"SELECT pg_try_advisory_xact_lock{kind}(:a, :b)"), number).scalar_one():
            raise BusyError(later, code="lock_busy")
        return
    wait = text("SELECT set_config('lock_timeout', :ms, true)")
    connection.execute(wait, {"ms": str(int(1e3 * patience_s))})
    try:
        connection.execute(text(f"SELECT pg_advisory_xact_lock{kind}(:a, :b)"), number)
    except OperationalError as error:
        if getattr(error.orig, "sqlstate", None) == _NOT_AVAILABLE:
            raise BusyError(later, code="lock_busy") from error
        raise
    connection.execute(wait, {"ms": "0"})

"""Locks of a PostgreSQL server, in the place of locks of a shared folder: one database holds one map.

They are of a transaction: the server frees them when it ends, however it does, and when its connection is gone.
"""

from __future__ import annotations

from sqlalchemy import Connection, text
from sqlalchemy.exc import OperationalError

from gsmap.errors import BusyError

WRITER, ARRAYS = 1, 2
_OURS = 0x67736D70  # "gsmp": other programs in the same database number theirs otherwise
_NOT_AVAILABLE = "55P03"


def take(connection: Connection, lock: int, patience_s: float, busy: str, *, shared: bool = False) -> None:
    """Take a lock until the end of the connection's transaction.

    Args:
        lock: `WRITER` or `ARRAYS`.
        busy: what the others have been doing, for the error.
        shared: together with others who share it.

    Raises:
        BusyError: others kept it for ``patience_s``.
    """
    kind, number = "_shared" if shared else "", {"a": _OURS, "b": lock}
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

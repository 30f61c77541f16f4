"""Quarantined jobs, which crashed their processes and are skipped until a user requests them, and unreadable
captures, which are tried again whenever their files or folders are named."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from sqlalchemy import delete, insert, select

from gsmap.store.catalog import Catalog, now
from gsmap.store.schema import set_aside

CAPTURE = "capture"


@dataclass(frozen=True)
class QuarantineRecord:
    """A job or capture that was quarantined, with the reason.

    Args:
        what: the result of the job, ``graph KEY``, ``edge KEY``, ``comparison KEY`` or ``tile KEY``; or ``capture
            DIGEST``, of its path.
        about: ids of the scenes that the job reads, separated by spaces; for a tile the export folder; for a capture
            its path.
        reason: how its processes ended, or why the capture cannot be read.
        created_at: when it was quarantined.
    """

    what: str
    about: str
    reason: str
    created_at: str


class Quarantine:
    """The quarantined jobs and captures of a map.

    Attributes:
        encountered: those that this open map quarantined or skipped.
    """

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog
        self.encountered: dict[str, QuarantineRecord] = {}

    def list(self) -> list[QuarantineRecord]:
        """Return all records, oldest first."""
        with self._catalog.read() as connection:
            rows = connection.execute(select(set_aside).order_by(set_aside.c.created_at, set_aside.c.what))
            return [QuarantineRecord(**row) for row in rows.mappings()]

    def add(self, what: str, about: str, reason: str) -> None:
        """Quarantine a job or a capture; replace a record of the same kind and inputs, even of an older recipe."""
        row = {"what": what, "about": about, "reason": reason, "created_at": now()}
        kind = what.partition(" ")[0]
        with self._catalog.write() as connection:
            same = (set_aside.c.about == about) & set_aside.c.what.startswith(f"{kind} ")
            connection.execute(delete(set_aside).where(same if kind != "tile" else set_aside.c.what == what))
            connection.execute(insert(set_aside), row)
        self.encountered[what] = QuarantineRecord(**row)

    def forget(self, jobs: Collection[str]) -> None:
        """Release jobs that are to be tried again, are done, or are no longer needed."""
        with self._catalog.write() as connection:
            connection.execute(delete(set_aside).where(set_aside.c.what.in_(sorted(jobs))))
        for what in jobs:
            self.encountered.pop(what, None)

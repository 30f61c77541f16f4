"""Where a map was backed up to."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import insert, select

from gsmap.store.catalog import Catalog, now
from gsmap.store.schema import backups


@dataclass(frozen=True)
class StoredBackup:
    """A snapshot that was taken, or a clone that was made.

    Args:
        target: the folder or URL it went to, without secrets.
        snapshot: its name there; of a clone the word and its map id.
        created_at: when it was done.
        num_bytes: how many were sent.
    """

    number: int
    target: str
    snapshot: str
    created_at: str
    num_bytes: int


class Backups:
    """The backups that a map knows of; copies of a backup, and snapshots that were deleted there, it does not."""

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog

    def add(self, target: str, snapshot: str, num_bytes: int) -> None:
        row = {"target": target, "snapshot": snapshot, "created_at": now(), "num_bytes": num_bytes}
        with self._catalog.write() as connection:
            connection.execute(insert(backups), row)

    def list(self) -> list[StoredBackup]:
        """All, oldest first."""
        with self._catalog.read() as connection:
            return [
                StoredBackup(**row) for row in connection.execute(select(backups).order_by(backups.c.number)).mappings()
            ]

"""The record of a map's backups and clones."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import insert, select

from gsmap.store.catalog import Catalog, next_timestamp
from gsmap.store.schema import backups, scenes


@dataclass(frozen=True)
class StoredBackup:
    """A snapshot or a clone that was made of the map.

    Args:
        target: folder or URL of the backup, without secrets.
        snapshot: name of the snapshot; for a clone the word ``clone`` and its map id.
        created_at: when it was made.
        num_bytes: bytes that were sent.
    """

    number: int
    target: str
    snapshot: str
    created_at: str
    num_bytes: int


class Backups:
    """The backups recorded in a map. Copies of backups are not recorded, and deleted snapshots may still be listed."""

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog

    def add(self, target: str, snapshot: str, num_bytes: int) -> None:
        row = {"target": target, "snapshot": snapshot, "num_bytes": num_bytes}
        with self._catalog.write() as connection:
            # After every scene that is in it, whatever a clock said: purges list the backups that may hold a scene.
            when = next_timestamp(connection, scenes.c.ingested_at)
            connection.execute(insert(backups), row | {"created_at": when})

    def list(self) -> list[StoredBackup]:
        """Return all backups, oldest first."""
        with self._catalog.read() as connection:
            return [
                StoredBackup(**row) for row in connection.execute(select(backups).order_by(backups.c.number)).mappings()
            ]

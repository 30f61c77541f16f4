"""Backups of a map, and maps made from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from gsmap.types.rows.base import Row


@dataclass(frozen=True, eq=False, kw_only=True)
class SnapshotRow(Row):
    """One state of a map in a backup.

    Args:
        snapshot: its name; ``gsmap restore --at`` takes its beginning, too.
        created_at: the moment whose state it is; everything that was committed before is in it.
        map_id: the map's own id.
        revision: number of the newest revision; null before the first.
        counts: how many ``scenes`` (and ``removed`` ones), ``groups`` of arrays, ``graphs``, ``registrations`` and
            ``revisions`` it holds.
        num_files: how many files it consists of.
        num_bytes: their size.
        num_bytes_new: how much of that was sent for it; the rest was there.
        catalog_schema: number of its newest migration.
        gsmap_version: which gsmap took it.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "snapshot": "snapshot",
        "num_scenes": "scenes",
        "revision": "revision",
        "num_files": "files",
        "num_bytes": "bytes",
        "num_bytes_new": "new bytes",
    }

    snapshot: str
    created_at: str
    map_id: str
    revision: int | None
    counts: Mapping[str, int]
    num_files: int
    num_bytes: int
    num_bytes_new: int
    catalog_schema: str
    gsmap_version: str

    @property
    def num_scenes(self) -> int | None:
        """How many living scenes it holds."""
        return self.counts.get("scenes")


@dataclass(frozen=True, eq=False, kw_only=True)
class BackupReport(Row):
    """What a backup did.

    Args:
        dest: where it went, without secrets.
        snapshot: the state that was saved.
        num_files_new: how many files were sent; the rest was there.
        deleted: names of snapshots that ``--keep`` deleted.
        num_bytes_freed: by that.
        num_verified: how many files in the backup were read again; null without ``--verify``.
        problems: damage in the backup that the map could not mend, a line each.
        notes: what a person should know.
    """

    columns: ClassVar[Mapping[str, str]] = {"dest": "backup", "num_files_new": "files sent"}

    dest: str
    snapshot: SnapshotRow
    num_files_new: int
    deleted: tuple[str, ...] = ()
    num_bytes_freed: int = 0
    num_verified: int | None = None
    problems: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class RestoreReport(Row):
    """What a restore made.

    Args:
        path: the map.
        snapshot: the state that it has.
        catalog_schema: number of its newest migration.
        needs_migration: whether that is older than this gsmap's, so that ``gsmap migrate`` comes next.
    """

    columns: ClassVar[Mapping[str, str]] = {"path": "map", "catalog_schema": "schema"}

    path: str
    snapshot: SnapshotRow
    catalog_schema: str
    needs_migration: bool


@dataclass(frozen=True, eq=False, kw_only=True)
class CloneReport(Row):
    """What a clone made.

    Args:
        path: the new map.
        map_id: its id.
        source_map_id: of the map that it was made from.
        num_linked: how many files it shares with that map.
        num_copied: how many were copied.
        num_bytes_copied: their size.
    """

    columns: ClassVar[Mapping[str, str]] = {"path": "map", "num_linked": "files shared", "num_copied": "copied"}

    path: str
    map_id: str
    source_map_id: str
    num_linked: int
    num_copied: int
    num_bytes_copied: int

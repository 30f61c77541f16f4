"""Backups of a map, and maps made from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from gsmap.types.rows.base import Row


@dataclass(frozen=True, eq=False, kw_only=True)
class SnapshotRow(Row):
    """A snapshot of a map in a backup.

    Args:
        snapshot: name; ``gsmap restore --at`` also accepts its beginning.
        created_at: time of the saved state; everything committed before it is included.
        map_id: id of the map.
        revision: number of the newest revision; null before the first.
        counts: numbers of ``scenes`` (and ``removed`` ones), ``groups`` of arrays, ``graphs``, ``registrations`` and
            ``revisions``.
        num_files: number of files.
        num_bytes: size of its files.
        num_bytes_new: bytes sent for this snapshot; the rest was in the backup already.
        catalog_schema: number of its newest migration.
        gsmap_version: version of gsmap that made it.
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
        """Number of scenes in the snapshot that are not removed."""
        return self.counts.get("scenes")


@dataclass(frozen=True, eq=False, kw_only=True)
class BackupReport(Row):
    """The result of a backup.

    Args:
        dest: destination, without secrets.
        snapshot: the saved snapshot.
        num_files_new: number of files sent; the rest was in the backup already.
        deleted: names of snapshots that ``--keep`` deleted.
        num_bytes_freed: bytes freed by deleting snapshots.
        num_verified: number of files in the backup that were read again; null without ``--verify``.
        problems: damage in the backup that could not be repaired from the map, one line each.
        notes: remarks.
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
    """The result of a restore.

    Args:
        path: folder of the map.
        snapshot: the restored snapshot.
        catalog_schema: number of its newest migration.
        needs_migration: true if its schema is older than this gsmap's, so that ``gsmap migrate`` is needed.
    """

    columns: ClassVar[Mapping[str, str]] = {"path": "map", "catalog_schema": "schema"}

    path: str
    snapshot: SnapshotRow
    catalog_schema: str
    needs_migration: bool


@dataclass(frozen=True, eq=False, kw_only=True)
class CloneReport(Row):
    """The result of a clone.

    Args:
        path: folder of the new map.
        map_id: id of the new map.
        source_map_id: id of the source map.
        num_linked: number of files shared with the source map.
        num_copied: number of copied files.
        num_bytes_copied: size of the copied files.
    """

    columns: ClassVar[Mapping[str, str]] = {"path": "map", "num_linked": "files shared", "num_copied": "copied"}

    path: str
    map_id: str
    source_map_id: str
    num_linked: int
    num_copied: int
    num_bytes_copied: int

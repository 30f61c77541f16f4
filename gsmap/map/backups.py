"""Back up and restore a map."""

from __future__ import annotations

import os
from datetime import UTC, datetime

from gsmap.errors import ConfigError, CorruptError
from gsmap.ingest import parse_date
from gsmap.store import Store
from gsmap.store import backup as _backup
from gsmap.store.storage import open_storage
from gsmap.types.progress import Progress, silent
from gsmap.types.rows.backups import BackupReport, RestoreReport, SnapshotRow


def save(
    store: Store, target: str | os.PathLike[str], *, verify: bool, keep: int | None, progress: Progress = silent
) -> BackupReport:
    """Back up a map to a target (``gsmap backup MAP DEST``); see `gsmap.store.backup.save`."""
    return _backup.save(store, open_storage(target), verify=verify, keep=keep, progress=progress)


def snapshots(target: str | os.PathLike[str]) -> tuple[list[SnapshotRow], list[str]]:
    """Return the sound snapshots of a backup, oldest first, and one message per damaged snapshot.

    Raises:
        NotFoundError, StoreError: see `gsmap.store.backup.Backup.open`.
    """
    backup = _backup.Backup.open(target)
    rows, problems = list[SnapshotRow](), list[str]()
    for name in backup.names():
        try:
            rows.append(backup.snapshot(name).row())
        except CorruptError as error:
            problems.append(str(error))
    return rows, problems


def restore(
    target: str | os.PathLike[str],
    path: str | os.PathLike[str],
    *,
    at: str | None = None,
    catalog_url: str | None = None,
    progress: Progress = silent,
) -> RestoreReport:
    """Restore a map from a backup (``gsmap restore DEST MAP``); see `gsmap.store.backup.restore`."""
    return _backup.restore(open_storage(target), path, **_moment(at), catalog_url=catalog_url, progress=progress)


def _moment(at: str | None) -> dict[str, str | None]:
    """Return ``at`` as a UTC time if it is a date, and unchanged if it is the name of a snapshot."""
    if at is None or (len(at) > 16 and "Z-" in at):
        return {"snapshot": at}
    try:
        return {"at": datetime.fromisoformat(str(parse_date(at))).astimezone(UTC).isoformat(timespec="microseconds")}
    except ConfigError:
        return {"snapshot": at}

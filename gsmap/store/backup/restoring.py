"""Restore or clone a map: staged beside its path, verified byte by byte, and moved into place by one rename."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import shutil
import uuid
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from sqlalchemy import delete, insert, inspect, select

from gsmap.durable import sync_folder
from gsmap.errors import CorruptError, DiskError, DiskFullError, GsmapError, NotFoundError, StoreError, of_system
from gsmap.store import catalog as _catalog
from gsmap.store import migrate, schema, sqlite, staging, trust
from gsmap.store.arrays import StoredFile
from gsmap.store.backup.map_state import ARRAYS, MapState, OutdatedStateError, capture_state, read_file, read_state
from gsmap.store.backup.repository import Backup, Snapshot
from gsmap.store.backup.saving import TRANSFERS
from gsmap.store.branches import FOLDER as BRANCHES
from gsmap.store.catalog_copy import copy_catalog, drop_tables, empty_catalog, make_independent, open_sqlite_catalog
from gsmap.store.error_translation import translate_errors
from gsmap.store.storage import Storage
from gsmap.store.store import Store
from gsmap.types.progress import Progress, silent
from gsmap.types.rows.backups import CloneReport, RestoreReport
from gsmap.version import __version__

_TRIES = 4  # attempts while other processes prune
_log = logging.getLogger("gsmap.store")


def restore(
    place: Storage,
    path: str | os.PathLike[str],
    *,
    snapshot: str | None = None,
    at: str | None = None,
    catalog_url: str | None = None,
    progress: Progress = silent,
) -> RestoreReport:
    """Restore a map from a backup; it appears whole or not at all, with the id of the original.

    Args:
        path: a folder that does not exist.
        snapshot, at: see `Backup.find`.
        catalog_url: URL of an empty database for the catalog, as in `Store.create`, instead of ``map.sqlite``.

    Raises:
        NotFoundError: no such backup or snapshot, or the parent folder does not exist.
        CorruptError: the backup is damaged, or has invalid paths.
        StoreError: ``path`` exists, or is not writable.
    """
    backup = Backup.at(place)
    chosen = backup.find(snapshot, at=at)
    target = _check_target(path)
    files = backup.files(chosen)
    _require_room(target.parent, sum(file.size_bytes for file in files))
    with _staged(target) as folder, contextlib.ExitStack() as undo:
        _fetch_all(backup, files, folder, progress)
        state = _verify_catalogs(folder, files, chosen)
        _reset_catalogs(folder)
        _record_snapshot(folder, backup.storage.url, chosen)
        if catalog_url is not None:
            state = _move_catalog(folder, catalog_url, undo)
        _synchronise(folder)
        _put_in_place(folder, target)
        undo.pop_all()
        _confirm(target)
    if catalog_url is not None:
        trust.trust_new_map(target)
    return RestoreReport(
        path=str(path),
        snapshot=chosen.row(),
        catalog_schema=state.schema,
        needs_migration=state.schema < schema.HEAD,
    )


def clone(store: Store, path: str | os.PathLike[str], progress: Progress = silent) -> CloneReport:
    """Clone a map: a new id, its own catalog (SQLite), and shared arrays where the disk supports hard links.

    Arrays are never changed in place, so that changes of one map do not affect the other. Branches, exports, backups
    and leases are not cloned.

    Raises:
        StoreError, CorruptError, NotFoundError: as `restore`.
    """
    target = _check_target(path)
    for _ in range(_TRIES):
        with _staged(target) as folder, contextlib.suppress(OutdatedStateError):
            state = capture_state(store, folder, branches=False)
            made = _link_all(store, state, folder, target, progress)
            _reset_catalogs(folder)
            others = (schema.tiles, schema.exports, schema.backups)  # records of the original map
            make_independent(folder, others, id=made.map_id, created_at=_catalog.now(), gsmap_version=__version__)
            (folder / _catalog.LOCK_FILE).unlink(missing_ok=True)
            _synchronise(folder)
            _put_in_place(folder, target)
            _confirm(target)
            _note(store, made)
            return made
    raise StoreError(
        f"{store.catalog.folder}: other processes pruned the map faster than it could be copied: run the same "
        "command again",
        code="changed_meanwhile",
    )


def _note(store: Store, made: CloneReport) -> None:
    """Record a clone in the original map, as a place where purged scenes may still exist."""
    if store.catalog.writable:
        try:
            store.backups.add(made.path, f"clone {made.map_id}", made.num_bytes_copied)
        except GsmapError as error:
            _log.warning("the clone is complete, but the map could not record it: %s", error)


def _check_target(path: str | os.PathLike[str]) -> Path:
    target = Path(path).absolute()
    if os.path.lexists(target) and not (target.is_dir() and not target.is_symlink() and not any(target.iterdir())):
        raise StoreError(
            f"{path} exists already: name a folder that does not exist, or move it away first", code="already_exists"
        )
    if not target.parent.is_dir():
        raise NotFoundError(f"cannot make {path}: {target.parent} does not exist", code="folder_not_found")
    return target


@contextlib.contextmanager
def _staged(target: Path) -> Iterator[Path]:
    """Yield a staging folder beside the target, on the same disk."""
    with _writing(target), staging.beside(target) as folder:
        (folder / ARRAYS).mkdir()
        yield folder


def _fetch_all(backup: Backup, files: list[StoredFile], folder: Path, progress: Progress) -> None:
    for parent in sorted({(folder / file.path).parent for file in files}):
        parent.mkdir(parents=True, exist_ok=True)

    def fetch(file: StoredFile) -> None:
        with _writing(folder), contextlib.closing(backup.read(file)) as chunks:
            _write(folder / file.path, chunks)

    with ThreadPoolExecutor(TRANSFERS) as pool:
        waiting = [pool.submit(fetch, file) for file in files]
        try:
            for done, future in enumerate(waiting, 1):
                future.result()
                progress(done / len(files), f"reading, {done} of {len(files)} files")
        except BaseException:
            for future in waiting:
                future.cancel()
            raise


def _link_all(store: Store, state: MapState, folder: Path, target: Path, progress: Progress) -> CloneReport:
    linked = copied = num_bytes = 0
    for i, file in enumerate(state.files):
        place = folder / file.path
        if place.exists():  # catalog and settings, from `capture_state`
            continue
        place.parent.mkdir(parents=True, exist_ok=True)
        source = store.arrays.root.parent / file.path
        try:
            os.link(source, place, follow_symlinks=False)
            if place.is_symlink() or place.stat().st_size != file.size_bytes:
                place.unlink()
                raise FileNotFoundError(errno.ENOENT, "not what gsmap wrote", str(source))
            linked += 1
        except OSError:  # another disk, or one without links; `read_file` raises if the file is gone
            with contextlib.closing(read_file(store, file, folder)) as chunks:
                _write(place, chunks)
            copied, num_bytes = copied + 1, num_bytes + file.size_bytes
        progress(i / len(state.files), f"linking, {i} of {len(state.files)} files")
    return CloneReport(
        path=str(target),
        map_id=uuid.uuid4().hex,
        source_map_id=store.id,
        num_linked=linked,
        num_copied=copied,
        num_bytes_copied=num_bytes,
    )


def _write(path: Path, chunks: Iterator[bytes]) -> None:
    with open(path, "xb") as file:
        for chunk in chunks:
            file.write(chunk)
        file.flush()
        os.fsync(file.fileno())


def _verify_catalogs(folder: Path, files: list[StoredFile], snapshot: Snapshot) -> MapState:
    """Raise unless all files that the catalogs name are present and the map is the one in the snapshot."""
    there = {file.path: (file.size_bytes, file.sha256) for file in files}
    if sqlite.FILE not in there:
        raise CorruptError(f"snapshot {snapshot.name} has no {sqlite.FILE}", code="snapshot_lacks_file")
    for problem in sqlite.file_problems(folder / sqlite.FILE):
        raise CorruptError(f"snapshot {snapshot.name}: its catalog is damaged ({problem})", code="backup_damaged")
    state = read_state(folder / sqlite.FILE)
    named = [*state.files]
    for branch in _branches(folder):
        for problem in sqlite.structure_damage(branch / sqlite.FILE):
            raise CorruptError(
                f"snapshot {snapshot.name}: the catalog of branch {branch.name} is damaged ({problem})",
                code="backup_damaged",
            )
        named += read_state(branch / sqlite.FILE).files
    if (state.map_id, state.schema) != (snapshot.map_id, snapshot.schema):
        raise CorruptError(
            f"snapshot {snapshot.name} holds a map or a schema that differs from the one in its description",
            code="backup_damaged",
        )
    for file in named:
        if there.get(file.path) != (file.size_bytes, file.sha256):
            raise CorruptError(
                f"snapshot {snapshot.name} lacks {file.path}, which its catalog names", code="snapshot_lacks_file"
            )
    return state


def _reset_catalogs(folder: Path) -> None:
    """Delete leases and leftover log files, and write page digests."""
    for one in (folder, *_branches(folder)):
        with contextlib.closing(open_sqlite_catalog(one)) as catalog, catalog.write() as connection:
            if inspect(connection).has_table("leases"):
                connection.execute(delete(schema.leases))
        for left in (_catalog.LOCK_FILE, f"{sqlite.FILE}-wal", f"{sqlite.FILE}-shm"):
            (one / left).unlink(missing_ok=True)


def _record_snapshot(folder: Path, url: str, snapshot: Snapshot) -> None:
    """Record in the map that it comes from a snapshot, which its own catalog does not name yet."""
    with contextlib.closing(open_sqlite_catalog(folder)) as catalog, catalog.write() as connection:
        if inspect(connection).has_table("backups"):
            row = {"target": url, "snapshot": snapshot.name, "created_at": snapshot.created_at}
            connection.execute(insert(schema.backups), row | {"num_bytes": snapshot.num_bytes_new})


def _branches(folder: Path) -> list[Path]:
    return sorted(file.parent for file in (folder / BRANCHES).glob(f"*/{sqlite.FILE}"))


def _move_catalog(folder: Path, url: str, undo: contextlib.ExitStack) -> MapState:
    """Copy ``map.sqlite`` to another database with the current schema, and store its URL in the map."""
    with contextlib.closing(open_sqlite_catalog(folder)) as own:
        migrate.upgrade(own)
        with own.read() as connection:
            map_id = connection.execute(select(schema.about.c.id)).scalar_one()
        there = empty_catalog(folder, url, map_id)
        undo.callback(drop_tables, folder, url)
        with translate_errors(folder):
            copy_catalog(own, there, leave_out=("leases",))
    state = read_state(folder / sqlite.FILE)
    for left in folder.glob(f"{sqlite.FILE}*"):
        left.unlink()
    there.close()
    return state


def _require_room(folder: Path, num_bytes: int) -> None:
    free = shutil.disk_usage(folder).free
    if free < num_bytes:
        raise DiskFullError(f"{folder} has room for {free / 1e6:.0f} MB, the map needs {num_bytes / 1e6:.0f} MB")


def _synchronise(folder: Path) -> None:
    for root, _, names in os.walk(folder):
        for name in names:
            if root.startswith(str(folder / ARRAYS)):
                continue  # synchronized when written, or a link to a synchronized file
            with open(Path(root) / name, "rb") as file:
                os.fsync(file.fileno())
        sync_folder(Path(root))


def _put_in_place(folder: Path, target: Path) -> None:
    os.rename(folder, target)  # replaces only an empty folder


def _confirm(target: Path) -> None:
    """Make the name durable; the map is in place already, so that a failure undoes nothing."""
    try:
        sync_folder(target.parent)
    except OSError as error:
        raise DiskError(
            f"{target} is restored completely, but the disk did not confirm the last write ({error.strerror}): "
            "check the disk"
        ) from error


@contextlib.contextmanager
def _writing(target: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        kind = of_system(error)
        reason = "the disk is full" if kind is DiskFullError else error.strerror or str(error)
        raise kind(f"{target} was not made: {reason}") from error

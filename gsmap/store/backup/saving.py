"""Save a backup: capture a state of the map, send missing objects, and write the snapshot last."""

from __future__ import annotations

import contextlib
import hashlib
import tempfile
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path

from gsmap.errors import ConfigError, CorruptError, GsmapError, StoreError
from gsmap.store.arrays import StoredFile
from gsmap.store.backup.backup_lease import SAVE, SWEEP, BackupLease
from gsmap.store.backup.map_state import (
    MapState,
    OutdatedStateError,
    capture_state,
    map_folder,
    pause_writers,
    read_file,
)
from gsmap.store.backup.repository import OBJECTS, SNAPSHOTS, Backup, Snapshot, digest_of, format_file_list, object_name
from gsmap.store.storage import FolderStorage, Storage
from gsmap.store.store import Store
from gsmap.types.progress import Progress, silent
from gsmap.types.rows.backups import BackupReport
from gsmap.version import __version__

TRANSFERS = 8  # concurrent transfers, because of the latency of remote storage
_TRIES = 4  # attempts while other processes prune; they are paused for the last one


def save(
    store: Store, storage: Storage, *, verify: bool = False, keep: int | None = None, progress: Progress = silent
) -> BackupReport:
    """Back up a map while other processes read and write it.

    Args:
        verify: read every existing object, and send damaged ones again.
        keep: afterwards delete all but this many of the newest snapshots, and the objects that only they need.

    Raises:
        CorruptError: the map is damaged: nothing damaged is sent, and no snapshot is written. A damaged catalog of a
            branch is left out, and no older snapshot is deleted.
        StoreError: the storage cannot be reached or written, is full, or holds other files.
        BusyError: another process is deleting for too long.
        ConfigError: ``keep`` is less than 1; a branch instead of the map; a folder inside the map.
    """
    if keep is not None and keep < 1:
        raise ConfigError(f"the number of snapshots to keep must be at least 1, got {keep}", code="out_of_range")
    home = map_folder(store).resolve()
    if store.catalog.folder.resolve() != home:
        raise ConfigError(f"branches are backed up with their map: pass {home}", code="backup_of_branch")
    if isinstance(storage, FolderStorage) and storage.root.resolve().is_relative_to(home):
        raise ConfigError(
            f"{storage.url} lies inside the map, and would be lost with it: name another folder",
            code="backup_inside_map",
        )
    backup = Backup.at_or_new(storage, store.id)
    _remove_leftovers(storage)
    with BackupLease(storage, SAVE) as lease:
        lease.wait_for_sweepers()
        run = _BackupRun(store, backup, lease, progress)
        found = run.verify() if verify else None
        before = backup.names()
        snapshot = run.save()
        problems = run.remaining_problems(found) if found is not None else ()
    notes = (*run.notes, *run.note(snapshot, before))
    problems = (*run.problems, *problems)
    saved = BackupReport(
        dest=storage.url,
        snapshot=snapshot.row(),
        num_files_new=run.num_sent,
        num_verified=None if found is None else found.num_read,
        problems=problems,
        notes=notes,
    )
    if keep is None:
        return saved
    if run.problems:
        kept = "no older snapshot was deleted, since this one does not hold the whole map"
        return replace(saved, notes=(*notes, kept))
    deleted, freed, sweep_notes = sweep(backup, keep, made=snapshot.name)
    return replace(saved, deleted=deleted, num_bytes_freed=freed, notes=(*notes, *sweep_notes))


def _remove_leftovers(storage: Storage) -> None:
    """Delete what killed backups left in the staging folder, and their leases, unless other processes are at work."""
    if storage.has_leftovers():
        with BackupLease(storage, SWEEP) as lease:
            if not lease.others():  # which also deletes leases of dead processes
                storage.drop_leftovers()


def sweep(backup: Backup, keep: int, *, made: str = "") -> tuple[tuple[str, ...], int, tuple[str, ...]]:
    """Delete all snapshots except the newest, then all objects that no remaining snapshot names.

    Nothing is deleted while another process is working in the backup, since it may rely on objects that no snapshot
    names yet.

    Args:
        made: name of the snapshot that was just made, which is always kept.

    Returns:
        Names of the snapshots deleted, bytes of the objects deleted, and notes.

    Raises:
        CorruptError: a kept snapshot cannot be read; nothing was deleted, since the objects that it needs are unknown.
    """
    storage = backup.storage
    with BackupLease(storage, SWEEP) as lease:
        if lease.others():
            return (), 0, (f"other processes use {storage.url}: the next backup with --keep deletes the old snapshots",)
        names = backup.names()
        kept = [*names[-keep:], *(name for name in names[:-keep] if name == made)]
        doomed = [name for name in names if name not in kept]
        needed = set()
        for name in kept:
            snapshot = backup.snapshot(name)
            needed |= {snapshot.files, *(file.sha256 for file in backup.files(snapshot))}
        for name in doomed:
            lease.require()
            storage.delete(f"{SNAPSHOTS}{name}.json")
        freed = 0
        for name, about in storage.list(OBJECTS).items():
            sha256 = digest_of(name)
            if sha256 is not None and sha256 not in needed:
                lease.require()
                storage.delete(name)
                freed += about.size_bytes
        storage.drop_leftovers()
    return tuple(doomed), freed, ()


@dataclass(frozen=True)
class _VerifiedObjects:
    """Result of `_BackupRun.verify`: number of objects read, damaged ones, and the snapshots that need each object."""

    num_read: int
    damaged: dict[str, str]
    needed: dict[str, tuple[StoredFile, list[str]]]


class _BackupRun:
    """One run of `save`."""

    def __init__(self, store: Store, backup: Backup, lease: BackupLease, progress: Progress) -> None:
        self.store = store
        self.backup = backup
        self.lease = lease
        self.progress = progress
        self.num_sent = 0
        self.notes: list[str] = []
        self.problems: tuple[str, ...] = ()  # of the map: what the snapshot lacks
        self._bytes_sent = 0
        self._counting = threading.Lock()
        self._bad: set[str] = set()  # digests of damaged objects

    def save(self) -> Snapshot:
        """Capture states of the map until all files of one state are sent."""
        for trial in range(_TRIES + 1):
            with contextlib.ExitStack() as until_sent, self._folder() as folder:
                if trial == _TRIES:
                    # Writers take the catalog lock before the arrays lock, so take both in this order.
                    with pause_writers(self.store):
                        until_sent.enter_context(self.store.arrays.lock())
                        state = capture_state(self.store, folder)
                else:
                    state = capture_state(self.store, folder)
                with contextlib.suppress(OutdatedStateError):
                    self._send(state, folder)
                    return self._write(state)
        name = self.store.catalog.folder
        raise StoreError(
            f"{name}: other processes pruned the map faster than it could be read: run the same command again; "
            "files that were sent are kept",
            code="changed_meanwhile",
        )

    def verify(self) -> _VerifiedObjects:
        """Read every object and compare it with its digest; find damaged and missing objects."""
        there = {sha: about for name, about in self.backup.storage.list(OBJECTS).items() if (sha := digest_of(name))}
        damaged: dict[str, str] = {}
        needed: dict[str, tuple[StoredFile, list[str]]] = {}

        def problem(sha256: str) -> str | None:
            file = StoredFile("", there[sha256].size_bytes, sha256)
            try:
                for _ in self.backup.read(file):
                    pass
            except CorruptError as error:
                return str(error)
            return None

        with ThreadPoolExecutor(TRANSFERS) as pool:
            for i, (sha256, problem_text) in enumerate(zip(there, pool.map(problem, there), strict=True)):
                self.progress(i / len(there), f"reading the files of the backup, {i} of {len(there)}")
                if problem_text is not None:
                    damaged[sha256] = problem_text
        for name in self.backup.names():
            with contextlib.suppress(CorruptError):  # reported by `remaining_problems`
                snapshot = self.backup.snapshot(name)
                own = StoredFile("", snapshot.files_bytes, snapshot.files)
                for file in [own, *self.backup.files(snapshot)]:
                    needed.setdefault(file.sha256, (file, []))[1].append(name)
        for sha256, (file, _) in needed.items():
            if sha256 not in there:
                damaged[sha256] = f"{self.backup.storage.url}/{object_name(sha256)} ({file.path}) is missing"
        self._bad = set(damaged)
        return _VerifiedObjects(len(there), damaged, needed)

    def remaining_problems(self, found: _VerifiedObjects) -> tuple[str, ...]:
        """Return the damage that remains in the backup after all files of the map were sent."""
        out = []
        for name in self.backup.names():
            try:
                snapshot = self.backup.snapshot(name)
                if snapshot.files not in self._bad:
                    self.backup.files(snapshot)
            except CorruptError as error:
                out.append(str(error))
        for sha256 in sorted(self._bad):
            file, names = found.needed.get(sha256, (None, []))
            if file is not None:
                out.append(
                    f"{found.damaged[sha256]}; the map no longer has this file, and {_format_names(names)} "
                    "cannot be restored"
                )
            elif sha256 in found.damaged:
                self.backup.storage.delete(object_name(sha256))  # unneeded, and must not be taken for a sound object
        return tuple(out)

    def note(self, snapshot: Snapshot, before: list[str]) -> tuple[str, ...]:
        """Record the backup in the map; return notes.

        Args:
            before: names of the earlier snapshots there.
        """
        target = self.backup.storage.url
        if not self.store.catalog.writable:
            return ("the map cannot be written, so it has no record of this backup",)
        try:
            known = {one.snapshot for one in self.store.backups.list()}
            self.store.backups.add(target, snapshot.name, snapshot.num_bytes_new)
            if before and before[-1] not in known:
                return (
                    f"this map has no record of snapshot {before[-1]} in {target}: if another copy of the map is "
                    "backed up there too, their snapshots mix; give each copy a folder of its own",
                )
        except GsmapError as error:
            return (f"the backup is complete, but the map could not record it: {error}",)
        return ()

    def _send(self, state: MapState, folder: Path) -> None:
        """Send all objects of a state that the storage lacks, each object once, in any order."""
        there = self._sound_sizes()
        missing = {f.sha256: f for f in state.files if there.get(f.sha256) != f.size_bytes}

        def send(file: StoredFile) -> None:
            self.lease.require()
            with contextlib.closing(read_file(self.store, file, folder)) as chunks:
                self.backup.storage.put(object_name(file.sha256), chunks, file.size_bytes)
            self._count(file)

        with ThreadPoolExecutor(TRANSFERS) as pool:
            sent = [pool.submit(send, file) for file in missing.values()]
            try:
                for done, future in enumerate(as_completed(sent), 1):
                    future.result()
                    self.progress(done / len(sent), f"sending, {done} of {len(sent)} files")
            except BaseException:
                for future in sent:
                    future.cancel()
                raise

    def _write(self, state: MapState) -> Snapshot:
        """Write the list of files, check that the storage has all of them, and write the snapshot."""
        self.problems = state.problems
        text = format_file_list(list(state.files))
        own = StoredFile("", len(text), hashlib.sha256(text).hexdigest())
        if self._sound_sizes().get(own.sha256) != own.size_bytes:
            self.backup.storage.put(object_name(own.sha256), [text], len(text))
            self._count(own)
        there = self._sound_sizes()
        for file in [own, *state.files]:
            name = object_name(file.sha256)
            listed_so = there.get(file.sha256) == file.size_bytes
            # Listings may lag behind, so check missing objects one by one.
            if not listed_so and self.backup.storage.size_bytes(name) != file.size_bytes:
                raise StoreError(
                    f"{self.backup.storage.url} lost {name} during the backup: run the same command again",
                    code="backup_file_missing",
                )
        created_at = self.backup.time_of_next(state.created_at)
        if created_at != state.created_at:
            self.notes.append(
                f"the newest snapshot there is from {created_at}, later than the clock of this machine: one of "
                "the clocks was wrong; this snapshot is dated right after that one"
            )
        snapshot = Snapshot(
            name="",
            map_id=state.map_id,
            created_at=created_at,
            schema=state.schema,
            gsmap_version=__version__,
            files=own.sha256,
            files_bytes=own.size_bytes,
            num_files=len(state.files),
            num_bytes=state.num_bytes,
            num_bytes_new=self._bytes_sent,
            revision=state.revision,
            counts=dict(state.counts),
        )
        name, packed = snapshot.packed()
        self.lease.require()
        Backup.at_or_new(self.backup.storage, state.map_id)  # still the same map
        self.backup.storage.put(f"{SNAPSHOTS}{name}.json", [packed], len(packed))
        return self.backup.snapshot(name)

    def _sound_sizes(self) -> dict[str, int]:
        """Return the size of every sound object by digest."""
        found = self.backup.storage.list(OBJECTS)
        sizes = {digest_of(name): about.size_bytes for name, about in found.items()}
        return {sha: size for sha, size in sizes.items() if sha is not None and sha not in self._bad}

    def _count(self, file: StoredFile) -> None:
        with self._counting:
            self._bad.discard(file.sha256)
            self.num_sent += 1
            self._bytes_sent += file.size_bytes

    @contextlib.contextmanager
    def _folder(self) -> Iterator[Path]:
        """Yield a folder for copies of catalogs, in a backup that is a folder with space, or else a temporary one."""
        storage = self.backup.storage
        if isinstance(storage, FolderStorage):
            with storage.staging() as folder:
                yield folder
        else:
            with tempfile.TemporaryDirectory(prefix="gsmap-") as name:
                yield Path(name)


def _format_names(names: list[str]) -> str:
    return f"snapshot {names[0]}" + (f" and {len(names) - 1} more" if len(names) > 1 else "")

"""Taking a backup: a state of the map is read, what the place lacks is sent, and the snapshot is written last."""

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
from gsmap.store.backup.repository import OBJECTS, SNAPSHOTS, Backup, Snapshot, digest_of, listed, object_name
from gsmap.store.backup.sharing import SAVE, SWEEP, Lease
from gsmap.store.backup.states import State, Vanished, capture, home_of, read_file, still
from gsmap.store.places import FolderPlace, Place
from gsmap.store.store import Store
from gsmap.types.progress import Progress, silent
from gsmap.version import __version__

TRANSFERS = 8  # objects on their way at a time: a store far away answers slowly, but many at once
_TRIES = 4  # states that are begun with while others prune; for the last one they wait


@dataclass(frozen=True)
class Saved:
    """What a backup did.

    Args:
        target: where it went.
        snapshot: the new one.
        num_files_new: objects that were sent.
        deleted: names of snapshots that were dropped.
        num_bytes_freed: by that.
        num_verified: objects that were read again; None where nobody asked for that.
        problems: damage in the backup that the map could not mend.
        notes: what a person should know.
    """

    target: str
    snapshot: Snapshot
    num_files_new: int
    deleted: tuple[str, ...] = ()
    num_bytes_freed: int = 0
    num_verified: int | None = None
    problems: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def save(
    store: Store, place: Place, *, verify: bool = False, keep: int | None = None, progress: Progress = silent
) -> Saved:
    """Back a map up, while others read and write it.

    Args:
        verify: read every object that is there already, and send again what is damaged.
        keep: afterwards delete all but this many of the newest snapshots, and what only they needed.

    Raises:
        CorruptError: the map is damaged: nothing damaged is sent, and no snapshot is written.
        StoreError: the place cannot be reached or written, is full, or holds something else.
        BusyError: others are at work for too long.
        ConfigError: ``keep`` is less than 1; a branch instead of the map; a folder inside the map.
    """
    if keep is not None and keep < 1:
        raise ConfigError(f"the number of snapshots to keep must be at least 1, got {keep}", code="out_of_range")
    home = home_of(store).resolve()
    if store.catalog.folder.resolve() != home:
        raise ConfigError(f"branches are backed up with their map: name {home}", code="backup_of_branch")
    if isinstance(place, FolderPlace) and place.root.resolve().is_relative_to(home):
        raise ConfigError(
            f"{place.url} lies inside the map: a backup must survive it; name another folder", code="place_inside_map"
        )
    backup = Backup.at_or_new(place, store.id)
    with Lease(place, SAVE) as lease:
        lease.wait_for_sweepers()
        run = _Run(store, backup, lease, progress)
        found = run.verify() if verify else None
        snapshot = run.save()
        problems = run.unmended(found) if found is not None else ()
    notes = (*run.notes, *run.note(snapshot))
    saved = Saved(
        place.url,
        snapshot,
        run.num_sent,
        num_verified=None if found is None else found.num_read,
        problems=problems,
        notes=notes,
    )
    if keep is None:
        return saved
    deleted, freed, said = sweep(backup, keep, made=snapshot.name)
    return replace(saved, deleted=deleted, num_bytes_freed=freed, notes=(*notes, *said))


def sweep(backup: Backup, keep: int, *, made: str = "") -> tuple[tuple[str, ...], int, tuple[str, ...]]:
    """Delete all but the newest snapshots, then the objects that no remaining one names.

    Nothing is deleted while anybody else is at work there: a backup relies on objects that no snapshot names yet.

    Args:
        made: name of the snapshot that was just taken, which stays in any case.

    Returns:
        Names of the snapshots that went, the bytes of objects that went, and remarks.

    Raises:
        CorruptError: a snapshot that stays cannot be read; nothing was deleted, since it is not known what it needs.
    """
    place = backup.place
    with Lease(place, SWEEP) as lease:
        if lease.others():
            return (), 0, (f"others are at work in {place.url}: old snapshots go with the next --keep",)
        names = backup.names()
        kept = [*names[-keep:], *(name for name in names[:-keep] if name == made)]
        doomed = [name for name in names if name not in kept]
        needed = set()
        for name in kept:
            snapshot = backup.snapshot(name)
            needed |= {snapshot.files, *(file.sha256 for file in backup.files(snapshot))}
        for name in doomed:
            lease.require()
            place.delete(f"{SNAPSHOTS}{name}.json")
        freed = 0
        for name, about in place.list(OBJECTS).items():
            sha256 = digest_of(name)
            if sha256 is not None and sha256 not in needed:
                lease.require()
                place.delete(name)
                freed += about.size_bytes
        place.drop_leftovers()
    return tuple(doomed), freed, ()


@dataclass(frozen=True)
class _Found:
    """What `_Run.verify` found: how many objects it read, the damaged ones, and which snapshots need which."""

    num_read: int
    damaged: dict[str, str]
    needed: dict[str, tuple[StoredFile, list[str]]]


class _Run:
    """One run of `save`."""

    def __init__(self, store: Store, backup: Backup, lease: Lease, progress: Progress) -> None:
        self.store = store
        self.backup = backup
        self.lease = lease
        self.progress = progress
        self.num_sent = 0
        self.notes: list[str] = []
        self._bytes_sent = 0
        self._counting = threading.Lock()
        self._bad: set[str] = set()  # objects that are there and damaged

    def save(self) -> Snapshot:
        """States are begun with until all of one is there."""
        for trial in range(_TRIES + 1):
            with contextlib.ExitStack() as until_sent, self._folder() as folder:
                if trial == _TRIES:
                    with still(self.store):  # first, in the order of writers, who may wait for the other lock with it
                        until_sent.enter_context(self.store.arrays.lock())
                        state = capture(self.store, folder)
                else:
                    state = capture(self.store, folder)
                with contextlib.suppress(Vanished):
                    self._send(state, folder)
                    return self._write(state)
        name = self.store.catalog.folder
        raise StoreError(
            f"{name}: others pruned it faster than it could be read; run it again, what was sent is kept",
            code="changed_meanwhile",
        )

    def verify(self) -> _Found:
        """Read every object that is there and compare it with its name, and with what the snapshots need."""
        there = {sha: about for name, about in self.backup.place.list(OBJECTS).items() if (sha := digest_of(name))}
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
            for i, (sha256, said) in enumerate(zip(there, pool.map(problem, there), strict=True)):
                self.progress(i / len(there), f"reading what is there, {i} of {len(there)}")
                if said is not None:
                    damaged[sha256] = said
        for name in self.backup.names():
            with contextlib.suppress(CorruptError):  # told by `unmended`
                snapshot = self.backup.snapshot(name)
                own = StoredFile("", snapshot.files_bytes, snapshot.files)
                for file in [own, *self.backup.files(snapshot)]:
                    needed.setdefault(file.sha256, (file, []))[1].append(name)
        for sha256, (file, _) in needed.items():
            if sha256 not in there:
                damaged[sha256] = f"{self.backup.place.url}/{object_name(sha256)} ({file.path}) is missing"
        self._bad = set(damaged)
        return _Found(len(there), damaged, needed)

    def unmended(self, found: _Found) -> tuple[str, ...]:
        """What is still wrong with the backup after everything that the map has was sent."""
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
                out.append(f"{found.damaged[sha256]}; the map has it no longer, and {_many(names)} cannot be restored")
            elif sha256 in found.damaged:
                self.backup.place.delete(object_name(sha256))  # nobody needs it, and it must not pass for the real one
        return tuple(out)

    def note(self, snapshot: Snapshot) -> tuple[str, ...]:
        """Let the map remember where it was backed up to."""
        target = self.backup.place.url
        if not self.store.catalog.writable:
            return ("the map cannot be written, so it does not remember this backup",)
        try:
            self.store.backups.add(target, snapshot.name, snapshot.num_bytes_new)
        except GsmapError as error:
            return (f"the backup is complete, but the map could not note it: {error}",)
        return ()

    def _send(self, state: State, folder: Path) -> None:
        """Everything of a state that the place lacks; each object once, in any order."""
        there = self._there()
        missing = {f.sha256: f for f in state.files if there.get(f.sha256) != f.size_bytes}

        def send(file: StoredFile) -> None:
            self.lease.require()
            with contextlib.closing(read_file(self.store, file, folder)) as chunks:
                self.backup.place.put(object_name(file.sha256), chunks, file.size_bytes)
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

    def _write(self, state: State) -> Snapshot:
        """The list of files, a last look at whether all of it is there, and then the snapshot."""
        text = listed(list(state.files))
        own = StoredFile("", len(text), hashlib.sha256(text).hexdigest())
        if self._there().get(own.sha256) != own.size_bytes:
            self.backup.place.put(object_name(own.sha256), [text], len(text))
            self._count(own)
        there = self._there()
        for file in [own, *state.files]:
            name = object_name(file.sha256)
            listed_so = there.get(file.sha256) == file.size_bytes
            # A listing may lag behind; asking for each object alone is a request for each.
            if not listed_so and self.backup.place.size_bytes(name) != file.size_bytes:
                raise StoreError(f"{self.backup.place.url} lost {name}: run it again", code="backup_file_missing")
        created_at = self.backup.time_of_next(state.created_at)
        if created_at != state.created_at:
            self.notes.append(
                f"the newest snapshot there is from {created_at}, later than this clock: one of the clocks was wrong; "
                "this snapshot is dated right after it"
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
        Backup.at_or_new(self.backup.place, state.map_id)  # still ours
        self.backup.place.put(f"{SNAPSHOTS}{name}.json", [packed], len(packed))
        return self.backup.snapshot(name)

    def _there(self) -> dict[str, int]:
        """Size of every sound object by digest."""
        found = self.backup.place.list(OBJECTS)
        sizes = {digest_of(name): about.size_bytes for name, about in found.items()}
        return {sha: size for sha, size in sizes.items() if sha is not None and sha not in self._bad}

    def _count(self, file: StoredFile) -> None:
        with self._counting:
            self._bad.discard(file.sha256)
            self.num_sent += 1
            self._bytes_sent += file.size_bytes

    @contextlib.contextmanager
    def _folder(self) -> Iterator[Path]:
        """Where the catalog is copied to: in the backup if that is a folder, which has room for it."""
        place = self.backup.place
        if isinstance(place, FolderPlace):
            with place.staging() as folder:
                yield folder
        else:
            with tempfile.TemporaryDirectory(prefix="gsmap-") as name:
                yield Path(name)


def _many(names: list[str]) -> str:
    return f"snapshot {names[0]}" + (f" and {len(names) - 1} more" if len(names) > 1 else "")

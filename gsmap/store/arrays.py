"""Immutable groups of arrays on disk (zarr v3), which are staged, synchronized and renamed to their final path.

A group is a folder ``arrays/KIND/ID`` with one archive in it (`gsmap.store.array_archive`). It appears by one rename
once all its bytes are on the disk, and is valid only once a committed row of the catalog names it. Every chunk has a
checksum (zarr's default codecs return wrong data for flipped bits, and zeros for a missing file), and the digest of
every file is stored in the catalog.

`Arrays` hides where and how arrays are stored; `gsmap.store.object_arrays` keeps them in an object store.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import shutil
import stat
import threading
import uuid
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsmap import platform
from gsmap.durable import (
    files_below,
    is_folder,
    lock_within,
    open_file,
    refuse_links,
    remove_tree,
    sync_file,
    sync_folder,
)
from gsmap.errors import CorruptError, StoreError
from gsmap.store import array_archive, layout
from gsmap.store.column_types import is_array_kind, is_digest
from gsmap.store.error_translation import NOT_KEPT, display_name, translate_errors
from gsmap.store.layout import CHUNK_ROWS

_PIECE_BYTES = 1 << 20
_NOT_ITS_BYTES = (errno.EIO, errno.EACCES, errno.EPERM, errno.EMFILE, errno.ENFILE, errno.ENOMEM)


@dataclass(frozen=True)
class StoredFile:
    """A file of a group: its path relative to the group, size and digest."""

    path: str
    size_bytes: int
    sha256: str


@dataclass(frozen=True)
class StagedGroup:
    """A group that is complete on disk but not yet at its final path.

    Args:
        folder: where its files lie; empty for objects, which have their final names already.
        files: its manifest.
    """

    folder: Path
    files: tuple[StoredFile, ...]


class Arrays:
    """The array groups below one folder.

    Never reads, writes or deletes through a link in the folder, because a map may come from an untrusted source.

    Args:
        root: ``MAP/arrays``.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.url = str(root)
        self.staging = root / "staging"
        self._held = threading.local()
        self._inboxes: set[str] = set()

    @contextlib.contextmanager
    def stage(
        self, arrays: Mapping[str, np.ndarray | array_archive.StreamedArray], kind: str, name: str
    ) -> Iterator[StagedGroup]:
        """Stage arrays on disk and synchronize them; delete them when the block ends unless `publish` moved them.

        Args:
            kind, name: kind and id of the group.
        """
        with self.scratch() as folder:
            yield _write(folder, arrays)

    @contextlib.contextmanager
    def inbox(self) -> Iterator[str]:
        """Open an inbox: a folder in the staging area, into which other processes stage groups (`stage_into`) for this
        process to publish. Yield its name; delete it, with the groups that were not published, when the block ends.
        """
        with contextlib.ExitStack() as until_end:
            with translate_errors(self.root.parent, NOT_KEPT):
                folder = until_end.enter_context(self.scratch())
                folder.mkdir()
            self._inboxes.add(folder.name)
            try:
                yield folder.name
            finally:
                self._inboxes.discard(folder.name)

    def stage_into(
        self, inbox: str, arrays: Mapping[str, np.ndarray | array_archive.StreamedArray], kind: str, name: str
    ) -> StagedGroup:
        """Stage arrays in an inbox, whose process publishes or deletes them.

        Args:
            inbox: name of an open inbox of any process (`inbox`).
            kind, name: kind and id of the group.

        Raises:
            OSError: the inbox was closed, or this process cannot write to it.
        """
        with self._lock_staging():
            refuse_links(self.staging, inbox)
            folder = self.staging / inbox / uuid.uuid4().hex
            try:
                return _write(folder, arrays)
            except BaseException:
                with contextlib.suppress(OSError):
                    self._remove_staged(inbox, folder.name)
                raise

    def received(self, staged: StagedGroup, kind: str, name: str) -> StagedGroup:
        """Return a group that another process staged, after checking that it is in an open inbox of this process and
        has the files of its manifest.

        Args:
            kind, name: kind and id of the group.

        Raises:
            StoreError: it is not, or has not.
        """
        inbox, own = staged.folder.parent.name, staged.folder.name
        if inbox in self._inboxes and is_digest(own) and [file.path for file in staged.files] == [array_archive.FILE]:
            self._check_root()
            refuse_links(self.root, self.staging.name, inbox, own)
            folder = self.staging / inbox / own
            found = [(path, one.st_size, stat.S_ISREG(one.st_mode)) for path, one in files_below(folder).items()]
            if found == [(file.path, file.size_bytes, True) for file in staged.files]:
                return StagedGroup(folder, staged.files)
        raise unknown_group(staged)

    @contextlib.contextmanager
    def scratch(self) -> Iterator[Path]:
        """Yield the path of a temporary folder on the disk of the arrays; it does not exist yet."""
        with self._lock_staging():
            folder = self.staging / uuid.uuid4().hex
            try:
                yield folder
            finally:
                with contextlib.suppress(OSError):  # a published folder is no longer here
                    self._remove_staged(folder.name)

    @contextlib.contextmanager
    def stage_copies(
        self, source: Arrays, groups: Mapping[tuple[str, str], Sequence[StoredFile]]
    ) -> Iterator[dict[tuple[str, str], StagedGroup]]:
        """Stage copies of another map's groups; delete them when the block ends unless `publish` moved them.

        Files are hard links where the disk supports it, since no map writes to a stored file again; otherwise they are
        copies.

        Args:
            groups: manifest by (kind, name).

        Raises:
            CorruptError: a file is missing, or differs from its digest.
        """
        with self.scratch() as folder:
            folder.mkdir()
            yield {
                group: StagedGroup(source.copy_group(*group, files, folder / "-".join(group)), tuple(files))
                for group, files in groups.items()
            }

    @contextlib.contextmanager
    def lock(self, patience_s: float = 120.0) -> Iterator[None]:
        """Hold the lock for publishing and reclaiming groups.

        Held from publishing a group until the row that names it is committed, and while groups are reclaimed. The
        writer lock of one catalog does not suffice, because several catalogs may name these arrays
        (`gsmap.store.branches`). While holding it, wait for no lock of a catalog that other processes use. Reentrant
        within a thread.

        Raises:
            BusyError: another process kept the lock for ``patience_s``.
        """
        if getattr(self._held, "depth", 0):
            yield
            return
        handle = os.open(self.root, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
        try:
            lock_within(handle, patience_s, f"{self.root}: other processes have been writing arrays")
            self._held.depth = 1
            yield
        finally:
            self._held.depth = 0
            os.close(handle)

    def copy_group(self, kind: str, name: str, files: Sequence[StoredFile], target: Path) -> Path:
        """Copy a group to a new folder, verify every byte, and return ``target``.

        Raises:
            CorruptError: a file is missing, or differs from its digest.
        """
        return _copy_group(self._group_folder(kind, name), target, files)

    def file_chunks(self, kind: str, name: str, file: StoredFile) -> Iterator[bytes]:
        """Yield the bytes of a group's file in order.

        Raises:
            FileNotFoundError: the file is missing.
        """
        with open(open_file(self._group_folder(kind, name) / file.path), "rb") as opened:
            while chunk := opened.read(_PIECE_BYTES):
                yield chunk

    def exists(self, kind: str, name: str) -> bool:
        """Return True if anything exists at the path of a group."""
        return self._group_folder(kind, name).exists()

    def upload_model(self, path: str) -> None:
        """Upload a model from the local mirror by its path below the map; does nothing for a local map."""

    def fetch_model(self, path: str) -> None:
        """Download a model to the local mirror; does nothing for a local map.

        Raises:
            NotFoundError: the remote map has no such model.
        """

    def delete_models(self, named: Collection[str]) -> None:
        """Delete all models of a remote map except those in ``named``; does nothing for a local map."""

    def publish(self, staged: StagedGroup, kind: str, name: str) -> None:
        """Move a staged group to its final path; the caller must hold `lock`, and no row may name the group yet."""
        place = self._group_folder(kind, name)
        fresh = not place.parent.exists()
        place.parent.mkdir(parents=True, exist_ok=True)
        if fresh:
            sync_folder(self.root)
        self.drop(kind, name)  # an orphan left by a crash between rename and commit
        os.rename(staged.folder, place)
        sync_folder(place.parent)

    def read(
        self,
        kind: str,
        name: str,
        files: Sequence[StoredFile],
        *,
        only: Sequence[str] | None = None,
        optional: Sequence[str] = (),
        rows: Sequence[tuple[int, int]] | None = None,
        shapes: Mapping[str, layout.Shape] | None = None,
        out: Callable[[], Mapping[str, np.ndarray]] | None = None,
    ) -> dict[str, np.ndarray]:
        """Read arrays of a group.

        Args:
            files: manifest of the group; missing or short files are detected before anything is read.
            only: names of the arrays to read.
            optional: names of arrays to read as well if the group has them.
            rows: ranges ``[start, stop)`` of rows, in order; default: all rows.
            shapes: expected shape of each array; None for an unknown length.
            out: called once the group has proved to hold what the shapes say; returns by name the arrays to read into,
                of the shape and type of the rows.

        Raises:
            CorruptError: a file is missing, short, or fails its checksum, or has a layout that gsmap does not write.
        """
        place = self._group_folder(kind, name)
        present = files_below(place)
        for file in files:
            path, found = place / file.path, present.get(file.path)
            if found is not None and not stat.S_ISREG(found.st_mode):
                raise CorruptError(
                    f"{path} is not a regular file (it is a link, pipe or device); gsmap creates none: remove it",
                    code="not_a_plain_file",
                )
            if found is None and not self.root.parent.is_dir():
                raise StoreError(
                    f"{display_name(self.root.parent)} was moved or deleted while it was open", code="changed_meanwhile"
                )
            if found is None or found.st_size != file.size_bytes:
                raise CorruptError(
                    f"{path} is missing or truncated: {layout.repair_advice(kind)}", code="arrays_missing"
                )
        try:
            with _open_body(place, kind, files) as body:
                checked = body.check_arrays(body.selected(only, optional), shapes)
                return body.read(checked, rows, None if out is None else out())
        except OSError as error:
            if error.errno in _NOT_ITS_BYTES:
                with translate_errors(place):
                    raise
            raise CorruptError(
                f"{place} cannot be read ({error}): {layout.repair_advice(kind)}", code="arrays_corrupt"
            ) from error

    def problems(self, kind: str, name: str, files: Sequence[StoredFile]) -> list[str]:
        """Read every byte of a group and return a message for each difference from the manifest."""
        place = self._group_folder(kind, name)
        out = []
        present = files_below(place)
        for file in files:
            path, found = place / file.path, present.get(file.path)
            if found is None:
                out.append(f"{path} is missing")
            elif not stat.S_ISREG(found.st_mode):
                out.append(f"{path} is not a regular file (it is a link, pipe or device)")
            elif found.st_size != file.size_bytes:
                out.append(f"{path} has {found.st_size} bytes, but gsmap wrote {file.size_bytes}")
            elif (problem := _content_problem(path, file.sha256)) is not None:
                out.append(problem)
        if not out:
            try:
                with _open_body(place, kind, files) as body:
                    body.check_arrays(body.array_names(), heads=True)
            except CorruptError as error:
                out.append(str(error))
        extra = sorted(set(present) - {file.path for file in files})
        return out + [f"{place / name} is not a file of the map" for name in extra]

    def size_bytes(self, kind: str, name: str) -> int:
        return sum(found.st_size for found in files_below(self._group_folder(kind, name)).values())

    def drop(self, kind: str, name: str) -> None:
        """Delete a group, which disappears for readers in one rename."""
        place = self._group_folder(kind, name)
        if os.path.lexists(place):
            self._make_staging()
            grave = self.staging / uuid.uuid4().hex
            os.rename(place, grave)
            with contextlib.suppress(OSError):
                self._remove_staged(grave.name)

    def kinds(self) -> list[str]:
        """Return the kinds of the groups on disk."""
        return [kind for kind in _names(self.root) if is_array_kind(kind) and is_folder(self.root / kind)]

    def groups(self) -> list[tuple[str, str]]:
        """Return (kind, name) of every group on disk, also of groups that no row names."""
        return [
            (kind, name)
            for kind in self.kinds()
            for name in _names(self.root / kind)
            if is_digest(name) and is_folder(self.root / kind / name)
        ]

    def unknown_entries(self) -> list[str]:
        """Return the paths of entries that are not groups, which gsmap never touches."""
        groups = {f"{kind}/{name}" for kind, name in self.groups()}
        kinds = self.kinds()
        out = [name for name in _names(self.root) if name not in kinds]
        out = [name for name in out if name != self.staging.name or not is_folder(self.staging)]
        return out + [f"{k}/{name}" for k in kinds for name in _names(self.root / k) if f"{k}/{name}" not in groups]

    def _group_folder(self, kind: str, name: str) -> Path:
        """Return the folder of a group after validating its name, which may come from an untrusted catalog."""
        if not is_array_kind(kind) or not is_digest(name):
            raise CorruptError(
                f"{kind}/{name} is not the name of an array group; nothing was changed",
                code="invalid_stored_name",
            )
        self._check_root()
        refuse_links(self.root, kind, name)
        return self.root / kind / name

    def _check_root(self) -> None:
        refuse_links(self.root.parent, self.root.name)

    def _make_staging(self) -> None:
        self._check_root()
        refuse_links(self.root, self.staging.name)
        if not self.root.is_dir():
            self.root.mkdir(exist_ok=True)  # not its parents: a map that was moved must not be begun anew
        self.staging.mkdir(exist_ok=True)

    def _remove_staged(self, *names: str) -> None:
        remove_tree(self.root.parent, self.root.name, self.staging.name, *names)

    def drop_leftovers(self, *, dry_run: bool = False) -> int:
        """Delete what killed writers left in the staging folder and return the bytes freed; skipped while a writer is
        staging.

        Args:
            dry_run: only count the bytes.
        """
        freed = 0
        if not is_folder(self.staging):
            return freed
        try:
            with self._lock_staging(to_clean=True):
                for name in _names(self.staging):
                    freed += sum(found.st_size for found in files_below(self.staging / name).values())
                    if not dry_run:
                        with contextlib.suppress(OSError):
                            self._remove_staged(name)
        except BlockingIOError:
            pass
        return freed

    @contextlib.contextmanager
    def _lock_staging(self, *, to_clean: bool = False) -> Iterator[None]:
        """Lock the staging folder: shared while staging, exclusive for cleaning up; the kernel frees the lock with the
        process."""
        self._make_staging()
        handle = os.open(self.staging, os.O_RDONLY | os.O_CLOEXEC | os.O_DIRECTORY | os.O_NOFOLLOW)
        try:
            platform.lock(handle, shared=not to_clean, wait=not to_clean)
            yield
        finally:
            os.close(handle)


@dataclass(frozen=True)
class ChunkedArray:
    """An array that is read in parts.

    Args:
        shape, dtype: of the whole array.
        parts: iterates over the parts from the first row on.
    """

    shape: tuple[int, ...]
    dtype: np.dtype
    parts: Callable[[], Iterator[np.ndarray]]


def digest(*arrays: np.ndarray | ChunkedArray, text: str = "") -> str:
    """Return 32 hex digits of the SHA-256 of a text and of the bytes, shapes and types of arrays."""
    out = hashlib.sha256(text.encode())
    for array in arrays:
        out.update(f"|{array.dtype.str}{array.shape}|".encode())
        for part in array.parts() if isinstance(array, ChunkedArray) else (array,):
            out.update(np.ascontiguousarray(part).reshape(-1).view(np.uint8).data)
    return out.hexdigest()[:32]


def link_or_copy(source: Path, target: Path) -> None:
    """Hard-link a file that is never written again, or copy it where the disk does not support links."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
        sync_file(target)


def _copy_group(place: Path, target: Path, files: Sequence[StoredFile]) -> Path:
    """Link or copy a group of another map, verify every byte, and return ``target``."""
    target.mkdir()
    present = files_below(place)
    for file in files:
        path, mine, found = place / file.path, target / file.path, present.get(file.path)
        if found is None or not stat.S_ISREG(found.st_mode) or found.st_size != file.size_bytes:
            raise CorruptError(
                f"{path} is missing or truncated: run gsmap check on that map and repair it first",
                code="arrays_missing",
            )
        mine.parent.mkdir(parents=True, exist_ok=True)
        link_or_copy(path, mine)
        if _sha256(mine) != file.sha256:
            raise CorruptError(
                f"{path} differs from what gsmap wrote: run gsmap check on that map and repair it first",
                code="bytes_differ",
            )
    for path in [*(p for p in target.rglob("*") if p.is_dir()), target]:
        sync_folder(path)
    return target


class _FolderReader:
    """Reads the files of a group in a folder, and keeps the file that was read last open."""

    def __init__(self, place: Path) -> None:
        self._folder = place
        self._open: tuple[str, int] | None = None

    def read(self, file: str, start: int, stop: int) -> bytes:
        if self._open is None or self._open[0] != file:
            self.close()
            self._open = file, open_file(self._folder / file)
        return os.pread(self._open[1], stop - start, start)

    def expect(self, file: str, ranges: Sequence[layout.Range]) -> None:
        """Do nothing: local reads need no prefetching."""

    def close(self) -> None:
        if self._open is not None:
            os.close(self._open[1])
            self._open = None


@contextlib.contextmanager
def _open_body(place: Path, kind: str, files: Sequence[StoredFile]) -> Iterator[layout.GroupReader]:
    reader = _FolderReader(place)
    try:
        yield layout.GroupReader(str(place), kind, {file.path: file.size_bytes for file in files}, reader)
    finally:
        reader.close()


def unknown_group(staged: StagedGroup) -> StoreError:
    """Return the error for a group that another process staged, but that is not there as its manifest says."""
    return StoreError(
        f"a worker staged arrays in {staged.folder}, but they are not there: run the same command again",
        code="changed_meanwhile",
    )


def _write(folder: Path, arrays: Mapping[str, np.ndarray | array_archive.StreamedArray]) -> StagedGroup:
    """Write arrays to a new folder and synchronize it."""
    folder.mkdir()
    array_archive.write(folder / array_archive.FILE, arrays, chunk_rows=CHUNK_ROWS)
    return StagedGroup(folder, _synchronise(folder))


def _synchronise(folder: Path) -> tuple[StoredFile, ...]:
    """Synchronize every file and folder to the disk and return the manifest."""
    out = []
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        with open(path, "rb") as file:
            os.fsync(file.fileno())
        out.append(stored_file(folder, str(path.relative_to(folder))))
    for path in [*(p for p in folder.rglob("*") if p.is_dir()), folder]:
        sync_folder(path)
    return tuple(out)


def stored_file(folder: Path, path: str) -> StoredFile:
    """Return the manifest entry of a file below a folder."""
    with open(folder / path, "rb") as file:
        return StoredFile(path, os.fstat(file.fileno()).st_size, hashlib.file_digest(file, "sha256").hexdigest())


def _names(folder: Path) -> list[str]:
    """List the entries of a folder; empty if it is missing or a link."""
    return sorted(os.listdir(folder)) if is_folder(folder) else []


def _sha256(path: Path) -> str:
    with open(open_file(path), "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _content_problem(path: Path, sha256: str) -> str | None:
    try:
        same = _sha256(path) == sha256
    except OSError as error:  # report a failing disk as a problem, so that `check` can go on
        return f"{path} cannot be read: {error.strerror or error}"
    return None if same else f"{path} differs from what gsmap wrote"

"""Immutable groups of arrays on disk (zarr v3), staged beside, synchronised, renamed into place.

A group is a folder ``arrays/KIND/ID`` with one archive in it (`gsmap.store.packed`). It appears by one rename once all
its bytes are on the disk, and counts only once a committed row of the catalog names it. Every chunk is checksummed
(zarr's default codecs return wrong data for flipped bits, and zeros for a missing file), and the digest of every file
goes into the catalog.

This class is the seam for arrays elsewhere than in a local folder: nothing else knows where or how they lie. Those of
`gsmap.store.object_arrays` lie in an object store.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
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
from gsmap.errors import CorruptError
from gsmap.store import layout, packed
from gsmap.store.columns import KINDS, is_digest
from gsmap.store.explained import explained
from gsmap.store.layout import CHUNK_ROWS

_PIECE_BYTES = 1 << 20
_NOT_ITS_BYTES = (errno.EIO, errno.EACCES, errno.EPERM, errno.EMFILE, errno.ENFILE, errno.ENOMEM)


@dataclass(frozen=True)
class StoredFile:
    """One file of a group: path relative to it, size and digest."""

    path: str
    size_bytes: int
    sha256: str


@dataclass(frozen=True)
class Staged:
    """A group that is complete on disk but not yet in its place."""

    folder: Path
    files: tuple[StoredFile, ...]


class Arrays:
    """The groups below one folder.

    Nothing in it is read, written or deleted through a link: it may come from a stranger.

    Args:
        root: ``MAP/arrays``.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.url = str(root)
        self.staging = root / "staging"
        self._held = threading.local()

    @contextlib.contextmanager
    def stage(self, arrays: Mapping[str, np.ndarray | packed.Column], kind: str, name: str) -> Iterator[Staged]:
        """Write arrays beside their place and synchronise them; dropped at the end unless `publish` took them.

        Args:
            kind, name: of the group that they are to be.
        """
        with self._lock_staging(fcntl.LOCK_SH):
            folder = self.staging / uuid.uuid4().hex
            try:
                folder.mkdir()
                packed.write(folder / packed.FILE, arrays, chunk_rows=CHUNK_ROWS)
                yield Staged(folder, _synchronise(folder))
            finally:
                with contextlib.suppress(OSError):  # there is nothing where it was published
                    self._remove_staged(folder.name)

    @contextlib.contextmanager
    def scratch(self) -> Iterator[Path]:
        """A folder for files that are needed for a moment, on the disk of the arrays; it is not made yet."""
        with self._lock_staging(fcntl.LOCK_SH):
            folder = self.staging / uuid.uuid4().hex
            try:
                yield folder
            finally:
                with contextlib.suppress(OSError):
                    self._remove_staged(folder.name)

    @contextlib.contextmanager
    def stage_copies(
        self, source: Arrays, groups: Mapping[tuple[str, str], Sequence[StoredFile]]
    ) -> Iterator[dict[tuple[str, str], Staged]]:
        """Bring groups of another map beside their places; dropped at the end unless `publish` took them.

        Files are linked where the disk allows, since no map ever writes to one again, and else copied.

        Args:
            groups: manifest by (kind, name).

        Raises:
            CorruptError: a file is missing, or differs from what was written.
        """
        with self._lock_staging(fcntl.LOCK_SH):
            folder = self.staging / uuid.uuid4().hex
            try:
                folder.mkdir()
                yield {
                    group: Staged(source.copied(*group, files, folder / "-".join(group)), tuple(files))
                    for group, files in groups.items()
                }
            finally:
                with contextlib.suppress(OSError):
                    self._remove_staged(folder.name)

    @contextlib.contextmanager
    def lock(self, patience_s: float = 120.0) -> Iterator[None]:
        """Held by the one who puts groups into their places, until a committed row names them, or who reclaims them.

        Several catalogs may name these arrays (`gsmap.store.branches`), so that the writer lock of one does not do. Who
        holds it waits for no lock of a catalog that others know. Again in the same thread: nothing.

        Raises:
            BusyError: another process kept it for ``patience_s``.
        """
        if getattr(self._held, "depth", 0):
            yield
            return
        handle = os.open(self.root, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
        try:
            lock_within(handle, fcntl.LOCK_EX, patience_s, f"{self.root}: others have been writing arrays")
            self._held.depth = 1
            yield
        finally:
            self._held.depth = 0
            os.close(handle)

    def copied(self, kind: str, name: str, files: Sequence[StoredFile], target: Path) -> Path:
        """Another copy of a group in a folder that is made for it, every byte compared; returns ``target``.

        Raises:
            CorruptError: a file is missing, or differs from what was written.
        """
        return _take(self._place(kind, name), target, files)

    def chunks(self, kind: str, name: str, file: StoredFile) -> Iterator[bytes]:
        """The bytes of a file, in order.

        Raises:
            FileNotFoundError: there is none.
        """
        with open(open_file(self._place(kind, name) / file.path), "rb") as opened:
            while chunk := opened.read(_PIECE_BYTES):
                yield chunk

    def exists(self, kind: str, name: str) -> bool:
        """Whether anything lies where a group should."""
        return self._place(kind, name).exists()

    def send_model(self, path: str) -> None:
        """Let the map's home have the copy of a model in its folder, by its path below the map; in a folder it has."""

    def bring_model(self, path: str) -> None:
        """Have that copy in the map's folder; there it is, unless the home is elsewhere.

        Raises:
            NotFoundError: the home has none.
        """

    def drop_models(self, named: Collection[str]) -> None:
        """Delete the copies of models at the map's home, if that is elsewhere, but those that are named."""

    def publish(self, staged: Staged, kind: str, name: str) -> None:
        """Move a staged group into its place; only under `lock`, and only where no row names that place."""
        place = self._place(kind, name)
        fresh = not place.parent.exists()
        place.parent.mkdir(parents=True, exist_ok=True)
        if fresh:
            sync_folder(self.root)
        self.drop(kind, name)  # an orphan of a crash between rename and commit
        os.rename(staged.folder, place)
        sync_folder(place.parent)

    def read(
        self,
        kind: str,
        name: str,
        files: Sequence[StoredFile],
        *,
        only: Sequence[str] | None = None,
        rows: Sequence[tuple[int, int]] | None = None,
        shapes: Mapping[str, layout.Shape] | None = None,
    ) -> dict[str, np.ndarray]:
        """Read arrays of a group.

        Args:
            files: its manifest; what is missing or short is found before anything is read.
            only: names of the arrays to read.
            rows: ranges ``[start, stop)`` of rows, in order; all where None.
            shapes: what the catalog says of the arrays; None for a length that it does not know.

        Raises:
            CorruptError: a file is missing, short, or fails its checksum, or gsmap does not write arrays so.
        """
        place = self._place(kind, name)
        present = files_below(place)
        for file in files:
            path, found = place / file.path, present.get(file.path)
            if found is not None and not stat.S_ISREG(found.st_mode):
                raise CorruptError(
                    f"{path} is no plain file (a link, pipe or device): gsmap made none; remove it",
                    code="not_a_plain_file",
                )
            if found is None or found.st_size != file.size_bytes:
                raise CorruptError(f"{path} is missing or cut off: {layout.mend(kind)}", code="arrays_missing")
        try:
            with _opened(place, kind, files) as body:
                names = body.array_names() if only is None else only
                return body.read(body.laid_out(names, shapes), rows)
        except OSError as error:
            if error.errno in _NOT_ITS_BYTES:
                with explained(place):
                    raise
            raise CorruptError(
                f"{place} cannot be read ({error}): {layout.mend(kind)}", code="arrays_corrupt"
            ) from error

    def problems(self, kind: str, name: str, files: Sequence[StoredFile]) -> list[str]:
        """What differs from the manifest, after reading every byte."""
        place = self._place(kind, name)
        out = []
        present = files_below(place)
        for file in files:
            path, found = place / file.path, present.get(file.path)
            if found is None:
                out.append(f"{path} is missing")
            elif not stat.S_ISREG(found.st_mode):
                out.append(f"{path} is no plain file (a link, pipe or device)")
            elif found.st_size != file.size_bytes:
                out.append(f"{path} has {found.st_size} bytes, {file.size_bytes} were written")
            elif (problem := _content_problem(path, file.sha256)) is not None:
                out.append(problem)
        if not out:
            try:
                with _opened(place, kind, files) as body:
                    body.laid_out(body.array_names(), heads=True)
            except CorruptError as error:
                out.append(str(error))
        extra = sorted(set(present) - {file.path for file in files})
        return out + [f"{place / name} does not belong there" for name in extra]

    def size_bytes(self, kind: str, name: str) -> int:
        return sum(found.st_size for found in files_below(self._place(kind, name)).values())

    def drop(self, kind: str, name: str) -> None:
        """Delete a group, in one rename as far as readers can see."""
        place = self._place(kind, name)
        if os.path.lexists(place):
            self._make_staging()
            grave = self.staging / uuid.uuid4().hex
            os.rename(place, grave)
            with contextlib.suppress(OSError):
                self._remove_staged(grave.name)

    def groups(self) -> list[tuple[str, str]]:
        """(kind, name) of every group on disk, named by a row or not."""
        return [
            (kind, name)
            for kind in KINDS
            for name in _names(self.root / kind)
            if is_digest(name) and is_folder(self.root / kind / name)
        ]

    def strangers(self) -> list[str]:
        """What lies among the groups and is none; gsmap did not make it and does not touch it."""
        groups = {f"{kind}/{name}" for kind, name in self.groups()}
        kinds = [kind for kind in _names(self.root) if not (kind in KINDS and is_folder(self.root / kind))]
        out = [kind for kind in kinds if kind != self.staging.name or not is_folder(self.staging)]
        return out + [f"{k}/{name}" for k in KINDS for name in _names(self.root / k) if f"{k}/{name}" not in groups]

    def _place(self, kind: str, name: str) -> Path:
        """Where a group lies; its name has been a row's, and that row a stranger's."""
        if kind not in KINDS or not is_digest(name):
            raise CorruptError(
                f"{kind}/{name} is not the name of a group of arrays: nothing is done with it",
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
        self.staging.mkdir(parents=True, exist_ok=True)

    def _remove_staged(self, name: str) -> None:
        remove_tree(self.root.parent, self.root.name, self.staging.name, name)

    def drop_leftovers(self, *, dry_run: bool = False) -> int:
        """Delete what dead writers left while staging; returns the bytes freed. Nothing while another is staging.

        Args:
            dry_run: only count.
        """
        freed = 0
        if not is_folder(self.staging):
            return freed
        try:
            with self._lock_staging(fcntl.LOCK_EX | fcntl.LOCK_NB):
                for name in _names(self.staging):
                    freed += sum(found.st_size for found in files_below(self.staging / name).values())
                    if not dry_run:
                        with contextlib.suppress(OSError):
                            self._remove_staged(name)
        except BlockingIOError:
            pass
        return freed

    @contextlib.contextmanager
    def _lock_staging(self, how: int) -> Iterator[None]:
        """Shared by those who stage, exclusive to clean up; the kernel frees it with the process."""
        self._make_staging()
        handle = os.open(self.staging, os.O_RDONLY | os.O_CLOEXEC | os.O_DIRECTORY | os.O_NOFOLLOW)
        try:
            fcntl.flock(handle, how)
            yield
        finally:
            os.close(handle)


@dataclass(frozen=True)
class Parts:
    """An array that is read part after part.

    Args:
        shape, dtype: of the whole.
        parts: reads it from its first row on.
    """

    shape: tuple[int, ...]
    dtype: np.dtype
    parts: Callable[[], Iterator[np.ndarray]]


def digest(*arrays: np.ndarray | Parts, text: str = "") -> str:
    """32 hex digits over the bytes, shapes and types of arrays, and a text."""
    out = hashlib.sha256(text.encode())
    for array in arrays:
        out.update(f"|{array.dtype.str}{array.shape}|".encode())
        for part in array.parts() if isinstance(array, Parts) else (array,):
            out.update(np.ascontiguousarray(part).reshape(-1).view(np.uint8).data)
    return out.hexdigest()[:32]


def link_or_copy(source: Path, target: Path) -> None:
    """Another name for a file that is never written again, or a copy where the disk has no such thing."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
        sync_file(target)


def _take(place: Path, target: Path, files: Sequence[StoredFile]) -> Path:
    """Another map's group as one of our own, every byte compared; returns ``target``."""
    target.mkdir()
    present = files_below(place)
    for file in files:
        path, mine, found = place / file.path, target / file.path, present.get(file.path)
        if found is None or not stat.S_ISREG(found.st_mode) or found.st_size != file.size_bytes:
            raise CorruptError(
                f"{path} is missing or cut off: run gsmap check on that map, and repair it first", code="arrays_missing"
            )
        mine.parent.mkdir(parents=True, exist_ok=True)
        link_or_copy(path, mine)
        if _sha256(mine) != file.sha256:
            raise CorruptError(
                f"{path} differs from what was written: run gsmap check on that map, repair it first",
                code="bytes_differ",
            )
    for path in [*(p for p in target.rglob("*") if p.is_dir()), target]:
        sync_folder(path)
    return target


class _Files:
    """The files of a group that is a folder; the one that was read last stays open until the end."""

    def __init__(self, place: Path) -> None:
        self._place = place
        self._open: tuple[str, int] | None = None

    def read(self, file: str, start: int, stop: int) -> bytes:
        if self._open is None or self._open[0] != file:
            self.close()
            self._open = file, open_file(self._place / file)
        return os.pread(self._open[1], stop - start, start)

    def expect(self, file: str, ranges: Sequence[layout.Range]) -> None:
        """Nothing: the disk is near."""

    def close(self) -> None:
        if self._open is not None:
            os.close(self._open[1])
            self._open = None


@contextlib.contextmanager
def _opened(place: Path, kind: str, files: Sequence[StoredFile]) -> Iterator[layout.Body]:
    reader = _Files(place)
    try:
        yield layout.Body(str(place), kind, {file.path: file.size_bytes for file in files}, reader)
    finally:
        reader.close()


def _synchronise(folder: Path) -> tuple[StoredFile, ...]:
    """Force every file and folder to the disk; the manifest of what was written."""
    out = []
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        with open(path, "rb") as file:
            os.fsync(file.fileno())
        out.append(stored_file(folder, str(path.relative_to(folder))))
    for path in [*(p for p in folder.rglob("*") if p.is_dir()), folder]:
        sync_folder(path)
    return tuple(out)


def stored_file(folder: Path, path: str) -> StoredFile:
    """A file below a folder as a manifest has it."""
    with open(folder / path, "rb") as file:
        return StoredFile(path, os.fstat(file.fileno()).st_size, hashlib.file_digest(file, "sha256").hexdigest())


def _names(folder: Path) -> list[str]:
    """What lies in a folder; nothing where it is missing or a link."""
    return sorted(os.listdir(folder)) if is_folder(folder) else []


def _sha256(path: Path) -> str:
    with open(open_file(path), "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _content_problem(path: Path, sha256: str) -> str | None:
    try:
        same = _sha256(path) == sha256
    except OSError as error:  # a disk that fails is what `check` is there to find
        return f"{path} cannot be read: {error.strerror or error}"
    return None if same else f"{path} differs from what was written"

"""Immutable groups of arrays on disk (zarr v3), staged beside, synchronised, renamed into place.

A group is a folder ``arrays/KIND/ID``. It appears by one rename once all its bytes are on the disk, and counts only
once a committed row of the catalog names it. Every chunk is checksummed (zarr's default codecs return wrong data for
flipped bits, and zeros for a missing file), and the digest of every file goes into the catalog.

This class is the seam for arrays elsewhere than in a local folder: nothing else knows where or how they lie.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import os
import shutil
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.durable import sync_folder
from gsmap.errors import CorruptError
from gsmap.store.explained import explained

CHUNK_ROWS = 16_384
SHARD_ROWS = 16 * CHUNK_ROWS
_ZSTD_LEVEL = 1
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

    Args:
        root: ``MAP/arrays``.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.staging = root / "staging"

    @contextlib.contextmanager
    def stage(self, arrays: Mapping[str, np.ndarray]) -> Iterator[Staged]:
        """Write arrays beside their place and synchronise them; dropped at the end unless `publish` took them."""
        with self._lock_staging(fcntl.LOCK_SH):
            folder = self.staging / uuid.uuid4().hex
            try:
                _write(folder, arrays)
                yield Staged(folder, _synchronise(folder))
            finally:
                if folder.exists():  # not published
                    shutil.rmtree(folder, ignore_errors=True)

    def publish(self, staged: Staged, kind: str, name: str) -> None:
        """Move a staged group into its place; only under the writer lock, and only where no row names that place."""
        place = self.root / kind / name
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
    ) -> dict[str, np.ndarray]:
        """Read arrays of a group.

        Args:
            files: its manifest; a missing or short file is found before zarr turns it into zeros.
            only: names of the arrays to read.
            rows: ranges ``[start, stop)`` of rows, in order; all where None.

        Raises:
            CorruptError: a file is missing, short, or fails its checksum.
        """
        import zarr

        place = self.root / kind / name
        for file in files:
            path = place / file.path
            if not path.is_file() or path.stat().st_size != file.size_bytes:
                raise CorruptError(f"{path} is missing or cut off: run gsmap check, and ingest the scene again")
        try:
            group = zarr.open_group(str(place), mode="r", zarr_format=3)
            return {key: _rows(group[key], rows) for key in (group.array_keys() if only is None else only)}
        except Exception as error:  # zarr and its codecs raise whatever they stumbled over
            if isinstance(error, OSError) and error.errno in _NOT_ITS_BYTES:
                with explained(place):
                    raise
            raise CorruptError(
                f"{place} cannot be read ({type(error).__name__}: {error}): run gsmap check, and ingest the scene again"
            ) from error

    def problems(self, kind: str, name: str, files: Sequence[StoredFile]) -> list[str]:
        """What differs from the manifest, after reading every byte."""
        place = self.root / kind / name
        out = []
        present = {str(p.relative_to(place)) for p in place.rglob("*") if p.is_file()} if place.is_dir() else set()
        for file in files:
            path = place / file.path
            if file.path not in present:
                out.append(f"{path} is missing")
            elif path.stat().st_size != file.size_bytes:
                out.append(f"{path} has {path.stat().st_size} bytes, {file.size_bytes} were written")
            elif (problem := _content_problem(path, file.sha256)) is not None:
                out.append(problem)
        return out + [f"{place / extra} does not belong there" for extra in sorted(present - {f.path for f in files})]

    def size_bytes(self, kind: str, name: str) -> int:
        return sum(p.stat().st_size for p in (self.root / kind / name).rglob("*") if p.is_file())

    def drop(self, kind: str, name: str) -> None:
        """Delete a group, in one rename as far as readers can see."""
        place = self.root / kind / name
        if place.exists():
            self.staging.mkdir(parents=True, exist_ok=True)
            grave = self.staging / uuid.uuid4().hex
            os.rename(place, grave)
            shutil.rmtree(grave, ignore_errors=True)

    def groups(self) -> list[tuple[str, str]]:
        """(kind, name) of every group on disk, named by a row or not."""
        if not self.root.is_dir():
            return []
        kinds = [k for k in sorted(self.root.iterdir()) if k.is_dir() and k != self.staging]
        return [(kind.name, group.name) for kind in kinds for group in sorted(kind.iterdir())]

    def drop_leftovers(self, *, dry_run: bool = False) -> int:
        """Delete what dead writers left while staging; returns the bytes freed. Nothing while another is staging.

        Args:
            dry_run: only count.
        """
        freed = 0
        if not self.staging.is_dir():
            return freed
        try:
            with self._lock_staging(fcntl.LOCK_EX | fcntl.LOCK_NB):
                for path in self.staging.iterdir():
                    freed += sum(p.stat().st_size for p in path.rglob("*") if p.is_file())
                    if not dry_run:
                        shutil.rmtree(path, ignore_errors=True)
        except BlockingIOError:
            pass
        return freed

    @contextlib.contextmanager
    def _lock_staging(self, how: int) -> Iterator[None]:
        """Shared by those who stage, exclusive to clean up; the kernel frees it with the process."""
        self.staging.mkdir(parents=True, exist_ok=True)
        handle = os.open(self.staging, os.O_RDONLY | os.O_CLOEXEC)
        try:
            fcntl.flock(handle, how)
            yield
        finally:
            os.close(handle)


def digest(*arrays: np.ndarray, text: str = "") -> str:
    """32 hex digits over the bytes, shapes and types of arrays, and a text."""
    out = hashlib.sha256(text.encode())
    for array in arrays:
        array = np.ascontiguousarray(array)
        out.update(f"|{array.dtype.str}{array.shape}|".encode())
        out.update(array.reshape(-1).view(np.uint8).data)
    return out.hexdigest()[:32]


def _write(folder: Path, arrays: Mapping[str, np.ndarray]) -> None:
    import zarr
    from zarr.codecs import ZstdCodec

    group = zarr.create_group(str(folder), zarr_format=3)
    for name, array in arrays.items():
        long = len(array) > CHUNK_ROWS
        chunk = (min(CHUNK_ROWS, max(1, len(array))), *(max(1, n) for n in array.shape[1:]))
        shard = (min(SHARD_ROWS, -(-len(array) // CHUNK_ROWS) * CHUNK_ROWS), *chunk[1:]) if long else None
        made = group.create_array(
            name,
            shape=array.shape,
            dtype=array.dtype,
            chunks=chunk,
            shards=shard,
            compressors=[ZstdCodec(level=_ZSTD_LEVEL, checksum=True)],
            fill_value=0,
            config={"write_empty_chunks": True},  # a chunk that is not there must be an error, not zeros
        )
        if array.size:
            made[...] = array


def _rows(array: Any, rows: Sequence[tuple[int, int]] | None) -> np.ndarray:
    if rows is None:
        return np.asarray(array[...])
    parts = [np.asarray(array[start:stop]) for start, stop in rows]
    return np.concatenate(parts) if parts else np.zeros((0, *array.shape[1:]), array.dtype)


def _synchronise(folder: Path) -> tuple[StoredFile, ...]:
    """Force every file and folder to the disk; the manifest of what was written."""
    out = []
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        with open(path, "rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
            os.fsync(file.fileno())
        out.append(StoredFile(str(path.relative_to(folder)), path.stat().st_size, sha256))
    for path in [*(p for p in folder.rglob("*") if p.is_dir()), folder]:
        sync_folder(path)
    return tuple(out)


def _content_problem(path: Path, sha256: str) -> str | None:
    try:
        with open(path, "rb") as file:
            same = hashlib.file_digest(file, "sha256").hexdigest() == sha256
    except OSError as error:  # a disk that fails is what `check` is there to find
        return f"{path} cannot be read: {error.strerror or error}"
    return None if same else f"{path} differs from what was written"

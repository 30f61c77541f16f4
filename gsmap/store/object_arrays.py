"""Array groups of a remote map, stored as objects ``arrays/KIND/ID/DIGEST-FILE``.

An object store has no rename and needs none: a group is valid only once a committed row of the catalog names it, so its
files are written under their final names before that. A name holds the digest of the bytes, so that an existing object
equals the one to be written: a request with a lost response, or a second writer of the same content, is no conflict. A
writer checks under the lock that the objects of a group still exist before naming it, and deleting unnamed objects
requires the same lock.

Partial reads need few requests: nearby ranges are merged. Files read whole, or nearly, are cached on this machine
(`gsmap.store.cache`); where the cache fails, their ranges are read into memory.
"""

from __future__ import annotations

import contextlib
import hashlib
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from gsmap.errors import CorruptError, NotFoundError, StoreError
from gsmap.store import array_archive, cache, layout
from gsmap.store.arrays import Arrays, StagedGroup, StoredFile, stored_file, unknown_group
from gsmap.store.column_types import is_array_kind, is_digest
from gsmap.store.layout import CHUNK_ROWS
from gsmap.store.remote_map import RemoteMap
from gsmap.store.storage import SINGLE_PUT_BYTES, chunks_of

_ROOT = "arrays"
MAX_REQUESTS = 5  # per partial read of a group, besides the one for its table of contents
_WHOLE = 0.5  # of a file: larger reads fetch the whole file


class ObjectArrays(Arrays):
    """The array groups of a remote map.

    Args:
        home: the remote map.
        lock: see `Arrays.lock`.
    """

    def __init__(self, home: RemoteMap, lock: Callable[[float], contextlib.AbstractContextManager[None]]) -> None:
        super().__init__(home.mirror / _ROOT)
        self.url = f"{home.url}/{_ROOT}"
        self._remote = home
        self._storage = home.storage
        self._lock = lock
        self._sent: set[str] = set()  # objects sent by this process and not yet named by a row

    @contextlib.contextmanager
    def scratch(self) -> Iterator[Path]:
        with tempfile.TemporaryDirectory(prefix="gsmap-") as folder:
            yield Path(folder) / "scratch"

    @contextlib.contextmanager
    def stage(
        self, arrays: Mapping[str, np.ndarray | array_archive.StreamedArray], kind: str, name: str
    ) -> Iterator[StagedGroup]:
        with tempfile.TemporaryDirectory(prefix="gsmap-") as folder:
            array_archive.write(Path(folder) / array_archive.FILE, arrays, chunk_rows=CHUNK_ROWS)
            staged = StagedGroup(Path(folder), (stored_file(Path(folder), array_archive.FILE),))
            self._send(staged, kind, name)
            yield staged

    @contextlib.contextmanager
    def inbox(self) -> Iterator[str]:
        yield ""  # other processes send objects to their final names

    def stage_into(
        self, inbox: str, arrays: Mapping[str, np.ndarray | array_archive.StreamedArray], kind: str, name: str
    ) -> StagedGroup:
        with self.stage(arrays, kind, name) as staged:
            for file in staged.files:
                if (key := self._key(kind, name, file)) not in self._sent and self._sha256(key) != file.sha256:
                    self._storage.put(key, chunks_of(staged.folder / file.path), file.size_bytes)
            return StagedGroup(Path(), staged.files)

    def received(self, staged: StagedGroup, kind: str, name: str) -> StagedGroup:
        for file in staged.files:
            key = self._key(kind, name, file)
            if file.path != array_archive.FILE or self._storage.size_bytes(key) != file.size_bytes:
                raise unknown_group(staged)
            self._sent.add(key)
        return StagedGroup(Path(), staged.files)

    @contextlib.contextmanager
    def stage_copies(
        self, source: Arrays, groups: Mapping[tuple[str, str], Sequence[StoredFile]]
    ) -> Iterator[dict[tuple[str, str], StagedGroup]]:
        with tempfile.TemporaryDirectory(prefix="gsmap-") as folder:
            staged = {
                group: StagedGroup(source.copy_group(*group, files, Path(folder) / "-".join(group)), tuple(files))
                for group, files in groups.items()
            }
            for group, one in staged.items():
                self._send(one, *group)
            yield staged

    @contextlib.contextmanager
    def lock(self, patience_s: float = 120.0) -> Iterator[None]:
        if getattr(self._held, "depth", 0):
            yield
            return
        with self._lock(patience_s):
            self._held.depth = 1
            try:
                yield
            finally:
                self._held.depth = 0

    def _send(self, staged: StagedGroup, kind: str, name: str) -> None:
        for file in staged.files:
            key, path = self._key(kind, name, file), staged.folder / file.path
            if file.size_bytes <= SINGLE_PUT_BYTES:
                try:
                    if self._storage.put_if_absent(key, path.read_bytes()):
                        self._sent.add(key)
                except StoreError:
                    if self._storage.size_bytes(key) != file.size_bytes:  # otherwise only the response was lost
                        raise
            elif self._storage.size_bytes(key) != file.size_bytes:  # S3 has no condition for objects of several parts
                self._storage.put(key, chunks_of(path), file.size_bytes)
                self._sent.add(key)

    def publish(self, staged: StagedGroup, kind: str, name: str) -> None:
        for file in staged.files:
            key = self._key(kind, name, file)
            whole = self._storage.size_bytes(key) == file.size_bytes  # otherwise a prune took it for an orphan
            if key not in self._sent:  # sent by another process
                whole = whole and self._sha256(key) == file.sha256
            if not whole:
                if staged.folder == Path():  # another process has the bytes
                    raise unknown_group(staged)
                self._storage.put(key, chunks_of(staged.folder / file.path), file.size_bytes)
            self._sent.discard(key)

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
        def read(reader: _ObjectReader) -> dict[str, np.ndarray]:
            try:
                body = self._body(reader, kind, name, files)
                checked = body.check_arrays(body.selected(only, optional), shapes)
                return body.read(checked, rows, None if out is None else out())
            except NotFoundError as error:
                raise CorruptError(
                    f"{error}, or it is incomplete: {layout.repair_advice(kind)}", code="arrays_corrupt"
                ) from error

        reader = _ObjectReader(self, kind, name, files)
        try:
            return read(reader)
        except CorruptError:
            if not reader.dropped():
                raise
        return read(_ObjectReader(self, kind, name, files, use_cached=False))

    def problems(self, kind: str, name: str, files: Sequence[StoredFile]) -> list[str]:
        out = []
        expected = {self._key(kind, name, file): file for file in files}
        for key, file in expected.items():
            found = self._sha256(key)
            if found is None:
                out.append(f"{self._storage.url}/{key} is missing")
            elif found != file.sha256:
                out.append(f"{self._storage.url}/{key} differs from what gsmap wrote")
        if not out and files:
            try:
                body = self._body(_ObjectReader(self, kind, name, files), kind, name, files)
                body.check_arrays(body.array_names())
            except (CorruptError, NotFoundError) as error:
                out.append(str(error))
        return out

    def upload_model(self, path: str) -> None:
        self._remote.upload(path, self._remote.mirror / path)

    def fetch_model(self, path: str) -> None:
        self._remote.fetch(path)

    def delete_models(self, named: Collection[str]) -> None:
        for key in self._storage.list("models/"):
            if key not in named:
                self._storage.delete(key)

    def copy_group(self, kind: str, name: str, files: Sequence[StoredFile], target: Path) -> Path:
        target.mkdir(parents=True)
        for file in files:
            with open(target / file.path, "xb") as copy:
                for chunk in self.file_chunks(kind, name, file):
                    copy.write(chunk)
            if stored_file(target, file.path) != file:
                raise CorruptError(
                    f"{self._storage.url}/{self._key(kind, name, file)} differs from what gsmap wrote",
                    code="bytes_differ",
                )
        return target

    def file_chunks(self, kind: str, name: str, file: StoredFile) -> Iterator[bytes]:
        return self._storage.get(self._key(kind, name, file))

    def _sha256(self, key: str) -> str | None:
        """Return the digest of an object's bytes; None without such an object."""
        digest = hashlib.sha256()
        try:
            for chunk in self._storage.get(key):
                digest.update(chunk)
        except NotFoundError:
            return None
        return digest.hexdigest()

    def size_bytes(self, kind: str, name: str) -> int:
        return sum(found.size_bytes for found in self._storage.list(self._prefix(kind, name)).values())

    def drop(self, kind: str, name: str) -> None:
        for key in self._storage.list(self._prefix(kind, name)):
            self._storage.delete(key)
            cache.drop(key.rpartition("/")[2][:32])

    def groups(self) -> list[tuple[str, str]]:
        found = {tuple(key.split("/")[1:3]) for key in self._storage.list(f"{_ROOT}/")}
        return sorted((kind, name) for kind, name in found if is_array_kind(kind) and is_digest(name))

    def exists(self, kind: str, name: str) -> bool:
        return bool(self._storage.list(self._prefix(kind, name)))

    def unknown_entries(self) -> list[str]:
        ours = {f"{_ROOT}/{kind}/{name}" for kind, name in self.groups()}
        return sorted(
            key[len(_ROOT) + 1 :] for key in self._storage.list(f"{_ROOT}/") if key.rpartition("/")[0] not in ours
        )

    def drop_leftovers(self, *, dry_run: bool = False) -> int:
        return 0  # sent but unnamed objects are orphans, deleted by `prune`

    def _body(self, reader: _ObjectReader, kind: str, name: str, files: Sequence[StoredFile]) -> layout.GroupReader:
        at = f"{self._storage.url}/{self._prefix(kind, name)}".rstrip("/")
        return layout.GroupReader(at, kind, {file.path: file.size_bytes for file in files}, reader)

    def _key(self, kind: str, name: str, file: StoredFile) -> str:
        if "/" in file.path:
            raise CorruptError(
                f"{kind}/{name} has a file {file.path!r}, which is not the name of an archive; nothing was changed",
                code="invalid_stored_name",
            )
        return f"{self._prefix(kind, name)}{file.sha256[:32]}-{file.path}"

    def _prefix(self, kind: str, name: str) -> str:
        if not is_array_kind(kind) or not is_digest(name):
            raise CorruptError(
                f"{kind}/{name} is not the name of an array group; nothing was changed",
                code="invalid_stored_name",
            )
        return f"{_ROOT}/{kind}/{name}/"


class _ObjectReader:
    """Read files of a group in an object store.

    Args:
        use_cached: read files that are in the cache already.
    """

    def __init__(
        self, arrays: ObjectArrays, kind: str, name: str, files: Sequence[StoredFile], *, use_cached: bool = True
    ) -> None:
        self._storage = arrays._storage
        self._files = {file.path: file for file in files}
        self._keys = {file.path: arrays._key(kind, name, file) for file in files}
        self._whole = {path: cache.find(file.sha256) if use_cached else None for path, file in self._files.items()}
        self._held: dict[str, list[tuple[int, bytes]]] = {path: [] for path in self._files}

    def read(self, file: str, start: int, stop: int) -> bytes:
        if (whole := self._whole[file]) is not None:
            try:
                with open(whole, "rb") as opened:
                    opened.seek(start)
                    return opened.read(stop - start)
            except FileNotFoundError:
                pass  # evicted from the cache
            except OSError as error:
                cache.report_failure(error)
            self._whole[file] = None
        for at, held in self._held[file]:
            if at <= start and stop <= at + len(held):
                return held[start - at : stop - at]
        (found,) = self._storage.get_ranges(self._keys[file], [(start, stop)])
        return found

    def expect(self, file: str, ranges: Sequence[layout.Range]) -> None:
        size = self._files[file].size_bytes
        missing = [r for r in ranges if not any(at <= r[0] and r[1] <= at + len(b) for at, b in self._held[file])]
        if self._whole[file] is not None or not missing:
            return
        few = merge_ranges(missing, MAX_REQUESTS)
        if sum(stop - start for start, stop in few) > _WHOLE * size:
            one = self._files[file]
            try:
                self._whole[file] = cache.keep(one.sha256, self._storage.get(self._keys[file]), self._keys[file])
                return
            except OSError as error:
                cache.report_failure(error)
        found = self._storage.get_ranges(self._keys[file], few)
        self._held[file] += [(start, content) for (start, _), content in zip(few, found, strict=True)]

    def dropped(self) -> bool:
        """Delete the group's files from the cache; return True if the cache had any."""
        kept = [self._files[path].sha256 for path, whole in self._whole.items() if whole is not None]
        for sha256 in kept:
            try:
                cache.drop(sha256)
            except OSError as error:
                cache.report_failure(error)
        return bool(kept)


def merge_ranges(ranges: Sequence[layout.Range], at_most: int) -> list[layout.Range]:
    """Merge byte ranges to at most ``at_most`` ranges, closing the smallest gaps first."""
    out: list[layout.Range] = []
    for start, stop in sorted(ranges):
        if out and start <= out[-1][1]:
            out[-1] = (out[-1][0], max(stop, out[-1][1]))
        else:
            out.append((start, stop))
    gaps = sorted(range(1, len(out)), key=lambda i: out[i][0] - out[i - 1][1])
    closed = set(gaps[: max(0, len(out) - at_most)])
    few: list[layout.Range] = []
    for i, (start, stop) in enumerate(out):
        if i in closed:
            few[-1] = (few[-1][0], stop)
        else:
            few.append((start, stop))
    return few

"""The layout of a backup, and reading it; all content is verified against its digest before use.

::

    gsmap-backup.json            which map this is a backup of
    objects/ab/<sha256>          bytes, once for all snapshots that need them
    snapshots/<time>-<id>.json   a state of the map; written last
    leases/<task>-<token>.json   who is at work here
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Generator, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Any

from gsmap.errors import CorruptError, NotFoundError, StoreError
from gsmap.store.arrays import StoredFile
from gsmap.store.backup.map_state import check_path, verify_chunks
from gsmap.store.catalog import timestamp_after
from gsmap.store.storage import Storage, open_storage
from gsmap.types.rows.backups import SnapshotRow
from gsmap.version import __version__

FORMAT = 1
MARKER = "gsmap-backup.json"
OBJECTS = "objects/"
SNAPSHOTS = "snapshots/"
_NAME = re.compile(r"\d{8}T\d{6}\.\d{6}Z-[0-9a-f]{16}")
_TIME = "%Y%m%dT%H%M%S.%f"
_DIGEST = re.compile(r"[0-9a-f]{64}")
_LINE = re.compile(r"([0-9a-f]{64}) (\d{1,18}) (.+)")
_MAX_TEXT_BYTES = 1 << 30  # of a list of files: ten million lines


@dataclass(frozen=True)
class Snapshot:
    """A snapshot in a backup.

    Args:
        name: its time, and a prefix of the digest of its description.
        map_id, created_at, schema, revision, counts: see `gsmap.store.backup.map_state.MapState`.
        gsmap_version: version of gsmap that made it.
        files: digest of the object that lists its files.
        num_files, num_bytes: of all its files.
        num_bytes_new: bytes that were sent for it.
    """

    name: str
    map_id: str
    created_at: str
    schema: str
    gsmap_version: str
    files: str
    files_bytes: int
    num_files: int
    num_bytes: int
    num_bytes_new: int
    revision: int | None
    counts: Mapping[str, int]

    @property
    def time(self) -> str:
        """Return ``created_at`` in the format of names."""
        return _compact(self.created_at)

    def row(self) -> SnapshotRow:
        """Return what verbs print of the snapshot."""
        row = {name: value for name, value in vars(self).items() if not name.startswith("files")}
        return SnapshotRow(snapshot=row.pop("name"), catalog_schema=row.pop("schema"), **row)

    def packed(self) -> tuple[str, bytes]:
        """Return the name of the snapshot's file, which follows from its bytes, and the bytes."""
        fields = {name: value for name, value in asdict(self).items() if name != "name"}
        text = json.dumps({"format": FORMAT, **fields}, indent=1).encode() + b"\n"
        return f"{self.time}Z-{hashlib.sha256(text).hexdigest()[:16]}", text


class Backup:
    """A storage with snapshots of one map."""

    def __init__(self, storage: Storage, map_id: str) -> None:
        self.storage = storage
        self.map_id = map_id

    @classmethod
    def open(cls, target: str | os.PathLike[str]) -> Backup:
        """Open the backup in a storage.

        Raises:
            NotFoundError: there is no backup.
            StoreError: its format is newer than this gsmap, or it cannot be reached.
        """
        return cls.at(open_storage(target))

    @classmethod
    def at(cls, storage: Storage) -> Backup:
        """Open the backup in an open storage; see `open`."""
        try:
            text = _read(storage, MARKER, 1 << 16)
        except NotFoundError:
            raise NotFoundError(
                f"{storage.url} is not a backup of a map: it lacks {MARKER}", code="not_a_backup"
            ) from None
        marker = _object(text, f"{storage.url}/{MARKER}")
        return cls(storage, _field(marker, "map_id", str, f"{storage.url}/{MARKER}"))

    @classmethod
    def at_or_new(cls, storage: Storage, map_id: str) -> Backup:
        """Open the backup in a storage, or create one in an empty storage.

        Raises:
            StoreError: the storage holds other files, or a backup of another map.
        """
        try:
            found = cls.at(storage)
        except NotFoundError:
            found = cls._begun(storage, map_id)
        if found.map_id != map_id:
            raise StoreError(
                f"{storage.url} is a backup of another map ({found.map_id}, not {map_id}): give each map its "
                "own folder",
                code="backup_of_another_map",
            )
        return found

    @classmethod
    def _begun(cls, storage: Storage, map_id: str) -> Backup:
        other = storage.first_name()
        if other is None:
            text = json.dumps({"format": FORMAT, "map_id": map_id}, indent=1).encode() + b"\n"
            storage.put(MARKER, [text], len(text))
        try:
            return cls.at(storage)  # another process may have created it at the same moment
        except NotFoundError:
            raise StoreError(
                f"{storage.url} holds files that are not of a backup ({other}): name an empty folder for the backup",
                code="folder_not_empty",
            ) from None

    def names(self) -> list[str]:
        """Return the names of the snapshots, oldest first."""
        listed = [name[len(SNAPSHOTS) :].removesuffix(".json") for name in self.storage.list(SNAPSHOTS)]
        return sorted(name for name in listed if _NAME.fullmatch(name))

    def time_of_next(self, now: str) -> str:
        """Return the time of the next snapshot: ``now``, or just after the newest snapshot if a clock was wrong.

        So the order of names is the order of creation, whatever the clocks.

        Args:
            now: ISO 8601, UTC.

        Raises:
            StoreError: no time is after the newest one.
        """
        names = self.names()
        newest = names[-1].split("Z-")[0] if names else ""
        if newest < _compact(now):
            return now
        try:
            return timestamp_after(datetime.strptime(newest, _TIME).replace(tzinfo=UTC))
        except (ValueError, OverflowError) as error:
            raise StoreError(
                f"snapshot {names[-1]} of {self.storage.url} has the largest possible time, so that no later "
                "snapshot can follow: delete its file",
                code="snapshot_in_future",
            ) from error

    def snapshot(self, name: str) -> Snapshot:
        """Load a snapshot by its full name.

        Raises:
            CorruptError: the snapshot is damaged.
        """
        where = f"{self.storage.url}/{SNAPSHOTS}{name}.json"
        text = _read(self.storage, f"{SNAPSHOTS}{name}.json", 1 << 20)
        if hashlib.sha256(text).hexdigest()[:16] != name[-16:]:
            raise CorruptError(
                f"{where} is damaged: restore another snapshot (--list shows them), and delete this one",
                code="backup_damaged",
            )
        data = _object(text, where)
        kinds: dict[str, Any] = {"revision": int | None, "counts": dict}
        kinds |= dict.fromkeys(("files_bytes", "num_files", "num_bytes", "num_bytes_new"), int)
        keys = [key for key in Snapshot.__dataclass_fields__ if key != "name"]
        found = Snapshot(name=name, **{key: _field(data, key, kinds.get(key, str), where) for key in keys})
        counts = all(key.isidentifier() and isinstance(count, int) for key, count in found.counts.items())
        if not _DIGEST.fullmatch(found.files) or found.map_id != self.map_id or not counts:
            raise CorruptError(f"{where} is not a snapshot of map {self.map_id}", code="backup_damaged")
        if found.time != name[: -len("Z-") - 16]:
            raise CorruptError(f"the time in {where} differs from the time in its name", code="backup_damaged")
        return found

    def find(self, name: str | None = None, *, at: str | None = None) -> Snapshot:
        """Load the newest snapshot, or the requested one.

        Args:
            name: its name, or at least six digits of the digest at its end.
            at: load the last one at or before this time, ISO 8601 in UTC.

        Raises:
            NotFoundError: no snapshot matches.
        """
        names = self.names()
        if not names:
            raise NotFoundError(
                f"{self.storage.url} has no snapshot yet: its first backup was not finished; run gsmap backup again",
                code="snapshot_not_found",
            )
        if name is not None:
            found = [one for one in names if name == one or (len(name) >= 6 and one[-16:].startswith(name))]
            if len(found) != 1:
                hint = "gsmap backup MAP DEST --list shows the snapshots"
                raise NotFoundError(
                    f"{self.storage.url} has no snapshot {name!r}, and {name!r} is not a time: {hint}",
                    code="snapshot_not_found",
                )
            return self.snapshot(found[0])
        earlier = [one for one in names if at is None or one.split("Z-")[0] <= _compact(at)]
        if not earlier:
            raise NotFoundError(
                f"{self.storage.url} has no snapshot at or before {at}: the first one is {names[0]}",
                code="snapshot_not_found",
            )
        return self.snapshot(earlier[-1])

    def files(self, snapshot: Snapshot) -> list[StoredFile]:
        """Return the files of a snapshot, with validated, unique paths relative to the map.

        Raises:
            CorruptError: the list is damaged or has invalid paths.
        """
        where = f"{self.storage.url}/{object_name(snapshot.files)}"
        if snapshot.files_bytes > _MAX_TEXT_BYTES:
            raise CorruptError(f"{where} is too long to be a list of files", code="backup_damaged")
        file_list = StoredFile("", snapshot.files_bytes, snapshot.files)
        text = b"".join(self.read(file_list)).decode("utf-8", errors="replace")
        out: dict[str, StoredFile] = {}
        for line in text.splitlines():
            parts = _LINE.fullmatch(line)
            if parts is None or parts[3] in out:
                raise CorruptError(f"{where} is not a list of files: {line[:200]!r}", code="backup_damaged")
            out[check_path(parts[3])] = StoredFile(parts[3], int(parts[2]), parts[1])
        return list(out.values())

    def read(self, file: StoredFile) -> Generator[bytes, None, None]:
        """Yield the bytes of an object, and verify its digest at the end.

        Raises:
            CorruptError: the object is missing or damaged. Bytes read so far must be discarded.
        """
        what = f"{self.storage.url}/{object_name(file.sha256)}" + (f" ({file.path})" if file.path else "")
        try:
            yield from verify_chunks(self.storage.get(object_name(file.sha256)), file, what)
        except NotFoundError:
            raise CorruptError(f"{what} is missing", code="backup_damaged") from None


def format_file_list(files: list[StoredFile]) -> bytes:
    """Format the list of files of a snapshot, with one line per file: digest, size and path."""
    return "".join(f"{file.sha256} {file.size_bytes} {file.path}\n" for file in files).encode()


def object_name(sha256: str) -> str:
    """Return the name of the object with this digest."""
    return f"{OBJECTS}{sha256[:2]}/{sha256}"


def digest_of(name: str) -> str | None:
    """Return the digest in the name of an object; None for other names."""
    sha256 = name.rpartition("/")[2]
    return sha256 if _DIGEST.fullmatch(sha256) and name == object_name(sha256) else None


def _compact(time: str) -> str:
    """Format an ISO time of UTC for file names: 20261121T194500.123456."""
    text = re.sub(r"[-:]", "", time.removesuffix("+00:00").removesuffix("Z"))
    return text if "." in text else f"{text}.000000"


def _read(storage: Storage, name: str, most_bytes: int) -> bytes:
    out = bytearray()
    for chunk in storage.get(name):
        out += chunk
        if len(out) > most_bytes:
            raise CorruptError(f"{storage.url}/{name} is too long", code="backup_damaged")
    return bytes(out)


def _object(text: bytes, where: str) -> dict[str, Any]:
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise CorruptError(f"{where} is damaged: it is not JSON", code="backup_damaged") from error
    if not isinstance(data, dict) or not isinstance(data.get("format"), int):
        raise CorruptError(f"{where} is damaged: it lacks its format number", code="backup_damaged")
    if data["format"] > FORMAT:
        raise StoreError(
            f"{where} was written by a newer gsmap than this ({__version__}): upgrade gsmap", code="backup_version"
        )
    return data


def _field(data: Mapping[str, Any], key: str, kind: Any, where: str) -> Any:
    value = data.get(key)
    if not isinstance(value, kind) or (isinstance(value, str) and not value.isprintable()):
        raise CorruptError(f"{where} is damaged: {key} has an invalid value", code="backup_damaged")
    return value

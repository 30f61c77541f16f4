"""Capture consistent states of a map for backups and clones: copies of its catalogs, and the files that they name."""

from __future__ import annotations

import contextlib
import hashlib
import re
import shutil
import sqlite3
from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from gsmap.errors import CorruptError, NotFoundError, StoreError
from gsmap.settings import FILE_NAME as SETTINGS
from gsmap.store import catalog as _catalog
from gsmap.store import sqlite
from gsmap.store.arrays import StoredFile
from gsmap.store.branches import FOLDER as BRANCHES
from gsmap.store.branches import MARKER as BRANCH_FILE
from gsmap.store.branches import branch_locations
from gsmap.store.catalog import Catalog
from gsmap.store.catalog_copy import copy_catalog, empty_catalog
from gsmap.store.error_translation import translate_errors
from gsmap.store.layout import repair_advice
from gsmap.store.models import FOLDER as MODELS
from gsmap.store.storage import chunks_of

if TYPE_CHECKING:
    from gsmap.store.store import Store

ARRAYS = "arrays"
_DIGEST = re.compile(r"[0-9a-f]{64}")


class OutdatedStateError(Exception):
    """A file of a state was pruned or repaired meanwhile, so that the state must be captured again."""


@dataclass(frozen=True)
class MapState:
    """The files of a map as of one moment.

    Args:
        map_id: of the map.
        created_at: when it was read, UTC; includes everything that was committed before.
        schema: of its catalog.
        files: paths relative to the map, with sizes and digests: arrays, models, settings and the catalogs.
        revision: number of the newest revision; None before the first.
        counts: numbers of ``scenes`` (without ``removed`` ones), ``groups``, ``graphs``, ``registrations``,
            ``revisions``.
        problems: damaged branches that are left out.
    """

    map_id: str
    created_at: str
    schema: str
    files: tuple[StoredFile, ...]
    revision: int | None
    counts: Mapping[str, int]
    problems: tuple[str, ...] = ()

    @property
    def num_bytes(self) -> int:
        return sum(file.size_bytes for file in self.files)


def map_folder(store: Store) -> Path:
    """Return the root folder of a map, also for a branch."""
    return store.arrays.root.parent


def capture_state(store: Store, folder: Path, *, branches: bool = True) -> MapState:
    """Copy the catalogs and settings of a map to an empty folder, and list the files that they name.

    The ``map.sqlite`` there is a snapshot whatever other processes write meanwhile: by SQLite's own backup, or row by
    row in one transaction of another database. So are the catalogs of branches, each at its own moment; a branch whose
    catalog is damaged is left out.

    Raises:
        CorruptError: the map's own catalog differs from its page digests, or names a file that the map lacks.
    """
    created_at = _catalog.now()
    home = map_folder(store)
    state = _capture_catalog(store.catalog, folder)
    files = {file.path: file for file in state.files}
    problems: list[str] = []
    for place in branch_locations(home) if branches else ():
        own = folder / BRANCHES / place.branch
        own.mkdir(parents=True)
        try:
            files |= {file.path: file for file in _capture_branch(place.folder, own).files}
        except (StoreError, FileNotFoundError) as error:
            if not place.folder.exists():  # deleted meanwhile
                shutil.rmtree(own)
            elif isinstance(error, CorruptError):
                problems.append(f"branch {place.branch} is left out: {error}")
                shutil.rmtree(own)
            else:
                raise
    for path in folder.rglob("*"):
        if path.name in (sqlite.FILE, SETTINGS, BRANCH_FILE):
            files[path.relative_to(folder).as_posix()] = _stored(path, folder)
    return MapState(
        state.map_id,
        created_at,
        state.schema,
        tuple(files[p] for p in sorted(files)),
        state.revision,
        state.counts,
        tuple(problems),
    )


@contextlib.contextmanager
def pause_writers(store: Store) -> Iterator[None]:
    """Keep all processes from writing to any catalog of a map, so that `capture_state` need not wait."""
    with contextlib.ExitStack() as held:
        held.enter_context(store.catalog.pause_writers())
        for place in branch_locations(map_folder(store)):
            held.enter_context(_catalog.pause_writers(place.folder, store.catalog.patience_s))
        yield


def read_state(file: Path, created_at: str = "") -> MapState:
    """List the files that a catalog names; the catalog is a ``map.sqlite`` of any schema that no process writes.

    Raises:
        CorruptError: the catalog cannot be read, or names a path outside the map.
    """
    connection = sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro&immutable=1", uri=True)
    try:
        connection.execute("PRAGMA trusted_schema = OFF")
        rows = connection.execute(
            "SELECT g.kind, g.id, f.path, f.size_bytes, f.sha256 FROM files f JOIN groups g ON g.id = f.group_id"
        )
        named = [StoredFile(f"{ARRAYS}/{kind}/{group}/{path}", size, sha) for kind, group, path, size, sha in rows]
        copied = "SELECT path, size_bytes, sha256 FROM models WHERE copied = 1 AND removed_at IS NULL"
        named += [StoredFile(*row) for row in connection.execute(copied)]
        for one in named:
            check_path(one.path)
            if not (isinstance(one.sha256, str) and _DIGEST.fullmatch(one.sha256) and isinstance(one.size_bytes, int)):
                raise CorruptError(f"{file}: the digest of {one.path} is malformed", code="backup_damaged")
        counts = {
            "scenes": "scenes WHERE removed_at IS NULL",
            "removed": "scenes WHERE removed_at IS NOT NULL",
            "graphs": "results WHERE kind = 'graphs'",
            **{name: name for name in ("groups", "registrations", "revisions")},
        }
        return MapState(
            map_id=str(_one(connection, "SELECT id FROM about")),
            created_at=created_at,
            schema=str(_one(connection, "SELECT version_num FROM alembic_version")),
            files=tuple({one.path: one for one in named}.values()),
            revision=_one(connection, "SELECT max(number) FROM revisions"),
            counts={name: int(_one(connection, f"SELECT count(*) FROM {rest}")) for name, rest in counts.items()},
        )
    except (sqlite3.Error, TypeError) as error:
        raise CorruptError(f"{file} is not the catalog of a map ({error})", code="backup_damaged") from error
    finally:
        connection.close()


def check_path(path: object) -> str:
    """Validate the relative path of a file in a map, before a list of files is used.

    Raises:
        CorruptError: the path leads outside the map, or where a map keeps no files.
    """
    if not isinstance(path, str) or not path.isprintable() or "\\" in path:
        raise CorruptError(f"{path!r} is not the path of a file in a map", code="invalid_stored_name")
    parts = path.split("/")
    sound = all(part not in ("", ".", "..") and len(part.encode()) <= 255 for part in parts)
    top, depth = parts[0], len(parts)
    if top == BRANCHES:
        top, depth = parts[-1], depth - 2
    known = (
        (top in (sqlite.FILE, SETTINGS) and depth == 1)
        or (parts[0] == BRANCHES and top == BRANCH_FILE and depth == 1)
        or (parts[0] == MODELS and depth == 2)
        or (parts[0] == ARRAYS and parts[1:2] not in (["staging"], []) and depth >= 4)
    )
    if not sound or not known or PurePosixPath(path).is_absolute():
        raise CorruptError(f"{path!r} is not the path of a file in a map", code="invalid_stored_name")
    return path


def read_file(store: Store, file: StoredFile, folder: Path) -> Generator[bytes, None, None]:
    """Yield the bytes of a state's file, and verify the file's digest at the end.

    Args:
        folder: where `capture_state` copied the catalogs to; other files are read from the map.

    Raises:
        OutdatedStateError: the file is gone, and no catalog names it any more.
        CorruptError: the file is missing or differs from its digest. Bytes read so far must be discarded.
    """
    immutable = file.path.split("/")[0] in (ARRAYS, MODELS)
    path = (map_folder(store) if immutable else folder) / file.path
    try:
        yield from verify_chunks(_bytes_of(store, file, path), file, str(path))
    except (CorruptError, FileNotFoundError, NotADirectoryError, NotFoundError) as error:
        if immutable and not _still_named(store, file):
            raise OutdatedStateError(file.path) from error
        if isinstance(error, CorruptError):
            raise CorruptError(f"{error}: {_mend(file)}", code="map_damaged") from error
        raise CorruptError(
            f"{path} is missing: {_mend(file)}, or gsmap prune if one was interrupted", code="map_damaged"
        ) from error
    except OSError as error:
        raise StoreError(f"{path} cannot be read: {error.strerror or error}", code="file_unreadable") from error


def _bytes_of(store: Store, file: StoredFile, path: Path) -> Iterator[bytes]:
    top, *rest = file.path.split("/")
    if top == MODELS:
        store.arrays.fetch_model(file.path)
    if top != ARRAYS:
        return chunks_of(path)
    kind, group, *within = rest
    return store.arrays.file_chunks(kind, group, replace(file, path="/".join(within)))


def _mend(file: StoredFile) -> str:
    top, kind, *_ = file.path.split("/")
    return repair_advice(kind) if top == ARRAYS else "restore it from a backup"


def verify_chunks(chunks: Iterator[bytes], file: StoredFile, what: str) -> Iterator[bytes]:
    """Yield the given bytes unchanged, and raise an error at the end if they do not match the file's digest.

    Raises:
        CorruptError: too many or too few bytes, or another digest.
    """
    seen, digest = 0, hashlib.sha256()
    for chunk in chunks:
        seen += len(chunk)
        if seen > file.size_bytes:
            break
        digest.update(chunk)
        yield chunk
    if seen != file.size_bytes:
        raise CorruptError(f"{what} does not have the {file.size_bytes} bytes that gsmap wrote", code="bytes_differ")
    if digest.hexdigest() != file.sha256:
        raise CorruptError(f"{what} differs from what gsmap wrote", code="bytes_differ")


def _capture_catalog(source: Catalog, folder: Path) -> MapState:
    file, file_name = folder / sqlite.FILE, source.folder / sqlite.FILE
    if source.is_sqlite:
        with translate_errors(source.folder):
            for problem in source.page_problems():
                raise CorruptError(f"{file_name}: {problem}: run gsmap check; it was not backed up", code="map_damaged")
            source.copy(file)
            for problem in sqlite.file_problems(file):
                raise CorruptError(f"{file_name} is damaged ({problem}); it was not backed up", code="map_damaged")
    else:
        made = empty_catalog(folder)
        try:
            copy_catalog(source, made, leave_out=("leases",))
        finally:
            made.close()
    with translate_errors(source.folder), contextlib.suppress(FileNotFoundError):
        settings = (source.folder / SETTINGS).read_bytes()
        with translate_errors(folder):
            (folder / SETTINGS).write_bytes(settings)
    return read_state(file)


def _capture_branch(source: Path, folder: Path) -> MapState:
    engine = _catalog.open_engine(source, writable=False)
    catalog = Catalog(source, engine, writable=False)
    try:
        (folder / BRANCH_FILE).write_bytes((source / BRANCH_FILE).read_bytes())
        return _capture_catalog(catalog, folder)
    finally:
        catalog.close()


def _stored(path: Path, folder: Path) -> StoredFile:
    with open(path, "rb") as opened:
        sha256 = hashlib.file_digest(opened, "sha256").hexdigest()
    return StoredFile(path.relative_to(folder).as_posix(), path.stat().st_size, sha256)


def _still_named(store: Store, file: StoredFile) -> bool:
    """Return True if any catalog of the map still names the file with this digest."""
    if _names(store.catalog, file):
        return True
    for place in branch_locations(map_folder(store)):
        catalog = Catalog(place.folder, _catalog.open_engine(place.folder, writable=False), writable=False)
        try:
            if _names(catalog, file):
                return True
        finally:
            catalog.close()
    return False


def _names(catalog: Catalog, file: StoredFile) -> bool:
    from sqlalchemy import select

    from gsmap.store.schema import files, models

    top, *rest = file.path.split("/")
    with catalog.read() as connection:
        if top == MODELS:
            current = (models.c.path == file.path) & models.c.removed_at.is_(None)
            return connection.execute(select(models.c.number).where(current)).first() is not None
        same = (files.c.group_id == rest[1]) & (files.c.path == "/".join(rest[2:])) & (files.c.sha256 == file.sha256)
        return connection.execute(select(files.c.path).where(same)).first() is not None


def _one(connection: sqlite3.Connection, query: str) -> Any:
    (value,) = connection.execute(query).fetchone()
    return value

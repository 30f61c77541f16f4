"""Storage of backups and remote maps: a folder, or a bucket of an object store, in which no partial objects appear."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import shutil
import stat
import tempfile
import urllib.parse
import uuid
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any, Protocol

from gsmap.durable import make_folder, open_file, sync_folder
from gsmap.errors import (
    ConfigError,
    DiskError,
    DiskFullError,
    GsmapError,
    MissingDependencyError,
    NotFoundError,
    ReadOnlyError,
    StoreError,
    of_system,
)
from gsmap.store.error_translation import displayed_as

CHUNK_BYTES = 1 << 20  # read, hashed and written at a time


def chunks_of(path: Path) -> Iterator[bytes]:
    """Yield the bytes of a file, without following a link."""
    with open(open_file(path), "rb") as file:
        while chunk := file.read(CHUNK_BYTES):
            yield chunk


SINGLE_PUT_BYTES = 64 << 20  # up to this size an object is one request; above, its parts appear as one at the end
_PART_BYTES = 16 << 20  # S3 allows 10,000 parts: objects of up to 160 GB
_SMALL_BYTES = 1 << 20  # larger bodies may take longer than _SILENCE to send, while the server is silent
_SILENCE = timedelta(seconds=30)  # a request is sent again if the server sends nothing for this long
_MAX_REQUEST = timedelta(minutes=10)
_MAX_RETRY = timedelta(minutes=12)  # above _MAX_REQUEST, or a request that timed out is not sent again
_EXPIRED = ("ExpiredToken", "InvalidToken", "TokenRefreshRequired")  # S3 sends them as 400 Bad Request
_STAGING = "staging"
_NAME = re.compile(r"[a-z0-9]+(/[0-9a-zA-Z._-]+){0,2}|gsmap-backup\.json")  # names that gsmap uses


@dataclass(frozen=True)
class ObjectInfo:
    """The size of an object, and the time of its last write (seconds, by the clock of the storage)."""

    size_bytes: int
    modified_s: float


class Storage(Protocol):
    """Named objects under one root. Names may contain slashes, and must be validated if they come from outside."""

    url: str  # shown to users and stored in the catalog, without secrets

    def list(self, prefix: str) -> dict[str, ObjectInfo]:
        """Return by name all objects whose name begins with ``prefix``, which is empty or a folder with its slash."""

    def first_name(self) -> str | None:
        """Return the name of any object; None if the storage is empty."""

    def size_bytes(self, name: str) -> int | None:
        """Return the size of an object in bytes; None if there is no such object."""

    def put(self, name: str, chunks: Iterable[bytes], size_bytes: int) -> None:
        """Write or replace an object durably; if ``chunks`` raises, leave the object unchanged."""

    def get(self, name: str) -> Iterator[bytes]:
        """Yield the bytes of an object in order; raise `NotFoundError` without such an object."""

    def delete(self, name: str) -> None:
        """Delete an object if it exists."""

    def has_leftovers(self) -> bool:
        """Return True if writers that were killed may have left files."""

    def drop_leftovers(self) -> None:
        """Delete leftovers of killed writers; no other process may write meanwhile."""


def open_storage(target: str | os.PathLike[str]) -> Storage:
    """Open the storage that a user names: a folder, ``file:///folder`` or ``s3://bucket/prefix``.

    Raises:
        ConfigError: another scheme, or a URL with a password or options.
        MissingDependencyError: S3 without the package ``obstore``.
    """
    text = os.fspath(target)
    scheme, found, _ = text.partition("://")
    if not found:
        return FolderStorage(Path(text))
    parts = urllib.parse.urlsplit(text)
    if scheme not in ("file", "s3"):
        raise ConfigError(
            f"a backup must go to a folder, file:///FOLDER or s3://BUCKET/PREFIX, got {scheme}://",
            code="invalid_location",
        )
    if "@" in parts.netloc or parts.query or parts.fragment:
        raise ConfigError(
            "the address of a backup must have no password and no options: set the AWS_... variables instead",
            code="invalid_location",
        )
    if scheme == "file":
        if parts.netloc not in ("", "localhost"):
            raise ConfigError(
                f"{text} is on another machine: write file:///FOLDER, with three slashes", code="invalid_location"
            )
        return FolderStorage(Path(urllib.parse.unquote(parts.path)))
    if not parts.netloc:
        raise ConfigError(f"{text} names no bucket: write s3://BUCKET/PREFIX", code="invalid_location")
    return BucketStorage(parts.netloc, parts.path.strip("/"))


class FolderStorage:
    """Storage in a folder. Objects are written below ``staging`` and renamed; links are not followed."""

    def __init__(self, root: Path) -> None:
        self.root = root.absolute()
        self.url = str(self.root)

    def list(self, prefix: str) -> dict[str, ObjectInfo]:
        if prefix and not prefix.endswith("/"):
            raise ValueError(f"a prefix must end with a slash, got {prefix!r}")
        out: dict[str, ObjectInfo] = {}
        with self._translate_errors():
            todo = [prefix] if prefix != f"{_STAGING}/" else []
            while todo:
                folder = todo.pop()
                with contextlib.suppress(FileNotFoundError), os.scandir(self.root / folder) as entries:
                    for entry in entries:
                        if entry.is_dir(follow_symlinks=False):
                            todo += [f"{folder}{entry.name}/"] if folder or entry.name != _STAGING else []
                        elif entry.is_file(follow_symlinks=False):
                            with contextlib.suppress(FileNotFoundError):  # deleted meanwhile
                                about = entry.stat(follow_symlinks=False)
                                out[f"{folder}{entry.name}"] = ObjectInfo(about.st_size, about.st_mtime)
        return out

    def first_name(self) -> str | None:
        with self._translate_errors(), contextlib.suppress(FileNotFoundError), os.scandir(self.root) as entries:
            return next((entry.name for entry in entries if entry.name != _STAGING), None)
        return None

    def size_bytes(self, name: str) -> int | None:
        with self._translate_errors(), contextlib.suppress(FileNotFoundError):
            about = self._path(name).lstat()
            return about.st_size if stat.S_ISREG(about.st_mode) else None
        return None

    @contextlib.contextmanager
    def staging(self) -> Iterator[Path]:
        """Yield a temporary folder in the storage."""
        with self._translate_errors():
            make_folder(self.root / _STAGING)
            folder = Path(tempfile.mkdtemp(dir=self.root / _STAGING))
        try:
            with displayed_as(folder, self.root):
                yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def put(self, name: str, chunks: Iterable[bytes], size_bytes: int) -> None:
        place = self._path(name)
        with self._translate_errors():
            try:
                self._put(place, chunks)
            except FileNotFoundError:
                if not isinstance(chunks, list):
                    raise
                # Only leases are written without a lease, so a sweeper may have deleted the staged file.
                self._put(place, chunks)

    def _put(self, place: Path, chunks: Iterable[bytes]) -> None:
        staged = self.root / _STAGING / uuid.uuid4().hex
        make_folder(staged.parent)
        try:
            with open(staged, "xb") as file:
                for chunk in chunks:
                    file.write(chunk)
                file.flush()
                os.fsync(file.fileno())
            make_folder(place.parent)
            os.replace(staged, place)
        finally:
            staged.unlink(missing_ok=True)
        sync_folder(place.parent)

    def get(self, name: str) -> Iterator[bytes]:
        with self._translate_errors():
            try:
                handle = os.open(self._path(name), os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
            except FileNotFoundError:
                raise NotFoundError(f"{self.url} has no {name}", code="backup_file_missing") from None
            with open(handle, "rb") as file:
                if not stat.S_ISREG(os.fstat(handle).st_mode):
                    raise StoreError(f"{self.url}: {name} is not a file", code="storage_failed")
                while chunk := file.read(CHUNK_BYTES):
                    yield chunk

    def delete(self, name: str) -> None:
        with self._translate_errors():
            self._path(name).unlink(missing_ok=True)

    def has_leftovers(self) -> bool:
        with (
            self._translate_errors(),
            contextlib.suppress(FileNotFoundError),
            os.scandir(self.root / _STAGING) as found,
        ):
            return any(found)
        return False

    def drop_leftovers(self) -> None:
        with (
            self._translate_errors(),
            contextlib.suppress(FileNotFoundError),
            os.scandir(self.root / _STAGING) as entries,
        ):
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    shutil.rmtree(entry.path, ignore_errors=True)
                else:
                    os.unlink(entry.path)

    def _path(self, name: str) -> Path:
        if not _NAME.fullmatch(name) or "/." in name:
            raise ValueError(f"{name!r} is not a valid name of an object")
        folder = self.root
        for part in name.split("/")[:-1]:
            folder = folder / part
            if folder.is_symlink():
                raise StoreError(
                    f"{folder} is a link: gsmap does not follow links in a backup; remove it", code="link_refused"
                )
        return self.root / name

    @contextlib.contextmanager
    def _translate_errors(self) -> Iterator[None]:
        try:
            yield
        except GsmapError:
            raise
        except OSError as error:
            kind = of_system(error)
            if kind is DiskFullError:
                text = f"{self.url}: the disk is full: free some space and repeat the command (sent files are kept)"
                raise DiskFullError(text) from error
            if kind is ReadOnlyError:
                raise ReadOnlyError(f"{self.url} cannot be written or read here ({error.strerror})") from error
            if kind is DiskError:
                raise DiskError(f"{self.url}: the disk failed ({error.filename or error.strerror})") from error
            if error.errno == errno.ELOOP:
                raise StoreError(
                    f"{error.filename} is a link: gsmap does not follow links in a backup; remove it",
                    code="link_refused",
                ) from error
            raise StoreError(
                f"{self.url}: {error.strerror or error} ({error.filename or 'no name'})", code="storage_failed"
            ) from error


class BucketStorage:
    """Storage below a prefix of an S3 bucket, through ``obstore``; endpoint and credentials come from the
    environment (``AWS_*``)."""

    def __init__(self, bucket: str, prefix: str) -> None:
        try:
            import obstore
            from obstore.store import S3Store
        except ImportError as error:
            raise MissingDependencyError("object stores need the package obstore", extra="cloud") from error
        self.url = f"s3://{bucket}/{prefix}".rstrip("/")
        endpoint = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or ""
        options: dict[str, Any] = {"endpoint": endpoint} if endpoint else {}
        client: Any = {"timeout": _MAX_REQUEST, "connect_timeout": timedelta(seconds=20)}
        if endpoint.startswith("http://"):  # the user chose plain HTTP
            client["allow_http"] = True
        self._api = obstore

        def connect(**limits: Any) -> S3Store:
            return S3Store(
                bucket,
                prefix=prefix or None,
                client_options=client | limits,
                retry_config={"max_retries": 6, "retry_timeout": _MAX_RETRY},
                checksum_algorithm="sha256",  # the server rejects corrupted uploads
                **options,
            )

        with self._translate_errors("open"):
            self._store = connect(read_timeout=_SILENCE)
            self._uploads = connect()  # the server is silent until it has the whole body

    def list(self, prefix: str) -> dict[str, ObjectInfo]:
        out: dict[str, ObjectInfo] = {}
        with self._translate_errors("list"):
            for batch in self._api.list(self._store, prefix=prefix or None, chunk_size=1000):
                out |= {found["path"]: ObjectInfo(found["size"], found["last_modified"].timestamp()) for found in batch}
        return out

    def first_name(self) -> str | None:
        with self._translate_errors("list"):
            for batch in self._api.list(self._store, chunk_size=1):
                return str(batch[0]["path"]) if batch else None
        return None

    def size_bytes(self, name: str) -> int | None:
        with self._translate_errors("read"), contextlib.suppress(FileNotFoundError):
            return int(self._api.head(self._store, name)["size"])
        return None

    def put(self, name: str, chunks: Iterable[bytes], size_bytes: int) -> None:
        try:
            with self._translate_errors("write"):
                if size_bytes <= SINGLE_PUT_BYTES:
                    self._api.put(self._sender(size_bytes), name, b"".join(chunks), use_multipart=False)
                else:
                    self._api.put(
                        self._uploads, name, iter(chunks), use_multipart=True, chunk_size=_PART_BYTES, max_concurrency=4
                    )
        except StorageRequestError:
            # The response may have been lost, not the object: an object named by its digest is the one sent.
            if name.startswith("objects/") and self.size_bytes(name) == size_bytes:
                return
            raise

    def _sender(self, size_bytes: int) -> Any:
        return self._store if size_bytes <= _SMALL_BYTES else self._uploads

    def put_if_absent(self, name: str, content: bytes) -> bool:
        """Write an object unless one of this name exists; return True if it was written."""
        from obstore.exceptions import AlreadyExistsError

        with self._translate_errors("write"):
            try:
                self._api.put(self._sender(len(content)), name, content, use_multipart=False, mode="create")
            except AlreadyExistsError:
                return False
        return True

    def get_ranges(self, name: str, ranges: Sequence[tuple[int, int]]) -> Sequence[bytes]:
        """Return the bytes of ranges ``[start, stop)`` of an object, one request per range; raises as `get`."""
        starts, ends = [start for start, _ in ranges], [stop for _, stop in ranges]
        with self._translate_errors("read"):
            try:
                found = self._api.get_ranges(self._store, name, starts=starts, ends=ends, coalesce=0)
            except FileNotFoundError:
                raise NotFoundError(f"{self.url} has no {name}", code="backup_file_missing") from None
        return [bytes(one) for one in found]

    def get(self, name: str) -> Iterator[bytes]:
        with self._translate_errors("read"):
            try:
                found = self._api.get(self._store, name)
            except FileNotFoundError:
                raise NotFoundError(f"{self.url} has no {name}", code="backup_file_missing") from None
            for chunk in found.stream(min_chunk_size=CHUNK_BYTES):
                yield bytes(chunk)

    def delete(self, name: str) -> None:
        with self._translate_errors("delete"), contextlib.suppress(FileNotFoundError):
            self._api.delete(self._store, name)

    def has_leftovers(self) -> bool:
        return False

    def drop_leftovers(self) -> None:
        """Do nothing: unfinished multipart uploads expire by a lifecycle rule of the bucket."""

    @contextlib.contextmanager
    def _translate_errors(self, what: str) -> Iterator[None]:
        from obstore.exceptions import BaseError, PermissionDeniedError, UnauthenticatedError

        try:
            yield
        except (BaseError, OSError) as error:
            refused = isinstance(error, (PermissionDeniedError, UnauthenticatedError))
            if refused or _error_code(error) in _EXPIRED:
                raise StorageRequestError(
                    f"{self.url}: not allowed to {what} ({_first_line(error)}): check the credentials "
                    "(AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_SESSION_TOKEN), which may have expired",
                    code="storage_refused",
                ) from error
            raise StorageRequestError(
                f"{self.url}: cannot {what} ({_first_line(error)}): check AWS_ENDPOINT_URL and the credentials "
                "(AWS_...), and try again",
                code="storage_failed",
            ) from error


class StorageRequestError(StoreError):
    """A request to an object store failed, or its response was lost."""


def _error_code(error: BaseException) -> str:
    """Return the code in the XML that a server sent with an error; empty without one."""
    found = re.search(r"<Code>(\w+)</Code>", str(error))
    return found[1] if found else ""


def _first_line(error: BaseException) -> str:
    """Return an error message with the code of a server's XML in place of the XML, and without a URL's password."""
    lines = re.split(r"\n|: <\?xml|: <Error>|\bDebug source", str(error).strip())
    without_password = re.sub(r"//[^\s/?#]*@", "//", lines[0])  # of an endpoint
    code = _error_code(error)
    return re.sub(r"\s+", " ", without_password)[:300] + (f": {code}" if code else "")

"""Remote maps, with arrays, models and settings in an object store and the catalog in PostgreSQL.

Each remote map has a local mirror: a folder with copies of ``catalog.url``, ``settings.toml`` and models, updated
whenever the map is opened. The mirror can be deleted without loss.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import urllib.parse
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from gsmap.durable import write_whole
from gsmap.errors import ConfigError, CorruptError, NotFoundError, of_system
from gsmap.settings import FILE_NAME as SETTINGS
from gsmap.store import cache, trust
from gsmap.store.error_translation import set_display_name
from gsmap.store.storage import BucketStorage, StorageRequestError, chunks_of, open_storage

_MAX_BYTES = 1 << 20  # of an object that is read whole
_FILES = (trust.URL_FILE, SETTINGS)


def is_remote(path: str | os.PathLike[str]) -> bool:
    """Return True if a path is the URL of an object store."""
    return os.fspath(path).startswith("s3://")


def local_folder(path: str | os.PathLike[str]) -> Path:
    """Return the folder of a path or ``file:///`` URL.

    Raises:
        ConfigError: a URL with another scheme.
    """
    text = os.fspath(path)
    scheme, found, rest = text.partition("://")
    if not found or "/" in scheme:
        return Path(text)
    if scheme != "file":
        raise ConfigError(
            f"a map must lie in a folder, at file:///FOLDER or at s3://BUCKET/PREFIX, got {scheme}://",
            code="invalid_location",
        )
    host, _, below = rest.partition("/")
    if host not in ("", "localhost"):
        raise ConfigError(
            f"{text} is on another machine: write file:///FOLDER, with three slashes", code="invalid_location"
        )
    return Path("/" + urllib.parse.unquote(below))


class RemoteMap:
    """A map in an object store.

    Args:
        url: ``s3://BUCKET/PREFIX``; credentials come from environment variables (``AWS_*``).

    Raises:
        ConfigError: the URL has a password or options, or no bucket.
        MissingDependencyError: the package ``obstore`` is not installed.
    """

    def __init__(self, url: str) -> None:
        storage = open_storage(url)
        assert isinstance(storage, BucketStorage)
        self.storage = storage
        self.url = storage.url
        self.mirror = cache.folder() / "desks" / hashlib.sha256(self.url.encode()).hexdigest()[:32]
        set_display_name(self.mirror, self.url)

    def exists(self) -> bool:
        return self.storage.size_bytes(trust.URL_FILE) is not None

    def refresh_mirror(self) -> None:
        """Update the catalog URL and settings in the mirror.

        Raises:
            NotFoundError: no map exists there.
            CorruptError: an object is too large.
        """
        with self._translate_errors():
            self._refresh_mirror()

    def _refresh_mirror(self) -> None:
        self.mirror.mkdir(mode=0o700, parents=True, exist_ok=True)
        (self.mirror / "arrays").mkdir(exist_ok=True)
        for name in _FILES:
            try:
                content = self._small(name)
            except NotFoundError:
                if name == trust.URL_FILE:
                    raise NotFoundError(
                        f"no map at {self.url}: create one with gsmap init {self.url}", code="map_not_found"
                    ) from None
                (self.mirror / name).unlink(missing_ok=True)
                continue
            if not (self.mirror / name).is_file() or (self.mirror / name).read_bytes() != content:
                write_whole(self.mirror / name, partial(_write, content))

    def claim(self, folder: Path) -> bool:
        """Upload the ``catalog.url`` in a folder, which creates the map; returns False if a map exists there.

        Raises:
            StorageRequestError: the storage refused the request or could not be reached; no map was created.
        """
        content = (folder / trust.URL_FILE).read_bytes()
        try:
            if self.storage.put_if_absent(trust.URL_FILE, content):
                return True
        except StorageRequestError:
            with contextlib.suppress(NotFoundError, StorageRequestError):
                if self._small(trust.URL_FILE) == content:  # only the response was lost
                    return True
            raise
        try:
            return self._small(trust.URL_FILE) == content  # sent twice, as the first response was lost
        except NotFoundError:  # 409 without an object: a conflicting request was under way
            raise StorageRequestError(
                f"{self.url}: cannot write ({trust.URL_FILE} conflicts with another request): try again",
                code="storage_failed",
            ) from None

    def upload_settings(self) -> None:
        """Upload the settings of the mirror."""
        path = self.mirror / SETTINGS
        if path.is_file():
            content = path.read_bytes()
            self.storage.put(SETTINGS, [content], len(content))
        else:
            self.storage.delete(SETTINGS)

    def upload(self, name: str, path: Path) -> None:
        """Upload a file that is named by its content, unless it exists."""
        if self.storage.size_bytes(name) != path.stat().st_size:
            self.storage.put(name, chunks_of(path), path.stat().st_size)

    def fetch(self, name: str) -> None:
        """Download a file that is named by its content to the mirror, unless it is there.

        Raises:
            NotFoundError: the remote map has no such file.
            CorruptError: the name leads outside the mirror.
        """
        folder, _, file = name.partition("/")
        if "/" in name.replace("/", "", 1) or {folder, file} & {"", ".", ".."}:
            raise CorruptError(
                f"{self.url} cannot have a file {name!r}; nothing was changed", code="invalid_stored_name"
            )
        target = self.mirror / name
        with self._translate_errors():
            if not target.is_file():
                target.parent.mkdir(exist_ok=True)
                write_whole(target, lambda staged: _fill(staged, self.storage.get(name)))

    @contextlib.contextmanager
    def _translate_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise of_system(error)(
                f"cannot write the local mirror of {self.url} in the cache {cache.folder()} "
                f"({error.strerror or error}): free some space, or set {cache.FOLDER_VARIABLE} to another folder"
            ) from error

    def _small(self, name: str) -> bytes:
        out = b""
        for chunk in self.storage.get(name):
            out += chunk
            if len(out) > _MAX_BYTES:
                raise CorruptError(
                    f"{self.url}/{name} is far too long, so gsmap did not write it: remove it", code="file_too_large"
                )
        return out


def _write(content: bytes, path: Path) -> None:
    path.write_bytes(content)


def _fill(path: Path, chunks: Iterator[bytes]) -> None:
    with open(path, "xb") as file:
        for chunk in chunks:
            file.write(chunk)

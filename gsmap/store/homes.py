"""Maps whose home is a bucket: arrays, models and settings are objects there, and the catalog is in PostgreSQL.

On this machine such a map has a *desk*, a folder that stands for it: copies of ``catalog.url`` and ``settings.toml`` as
the home has them, brought anew whenever the map is opened, and of models. Nothing is lost with it.
"""

from __future__ import annotations

import hashlib
import os
import urllib.parse
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from gsmap.durable import write_whole
from gsmap.errors import ConfigError, CorruptError, NotFoundError
from gsmap.settings import FILE_NAME as SETTINGS
from gsmap.store import cache, trust
from gsmap.store.explained import call
from gsmap.store.places import ObjectPlace, chunks_of, place_of

_MAX_BYTES = 1 << 20  # of what is brought to a desk; longer ones are not read
_FILES = (trust.URL_FILE, SETTINGS)


def is_remote(path: str | os.PathLike[str]) -> bool:
    """Whether a path names a bucket."""
    return os.fspath(path).startswith("s3://")


def local(path: str | os.PathLike[str]) -> Path:
    """The folder that a path or a ``file:///`` URL names.

    Raises:
        ConfigError: a URL of another kind.
    """
    text = os.fspath(path)
    scheme, found, rest = text.partition("://")
    if not found or "/" in scheme:
        return Path(text)
    if scheme != "file":
        raise ConfigError(
            f"a map lies in a folder, at file:///FOLDER or at s3://BUCKET/PREFIX, not at {scheme}://",
            code="invalid_location",
        )
    host, _, below = rest.partition("/")
    if host not in ("", "localhost"):
        raise ConfigError(
            f"{text} is on another machine: write file:///FOLDER, with three slashes", code="invalid_location"
        )
    return Path("/" + urllib.parse.unquote(below))


class Home:
    """A map's home in a bucket.

    Args:
        url: ``s3://BUCKET/PREFIX``; who we are says the environment (``AWS_*``).

    Raises:
        ConfigError: a URL with a password or options in it, or without a bucket.
        MissingDependencyError: the package ``obstore`` is not installed.
    """

    def __init__(self, url: str) -> None:
        place = place_of(url)
        assert isinstance(place, ObjectPlace)
        self.place = place
        self.url = place.url
        self.desk = cache.folder() / "desks" / hashlib.sha256(self.url.encode()).hexdigest()[:32]
        call(self.desk, self.url)

    def exists(self) -> bool:
        return self.place.size_bytes(trust.URL_FILE) is not None

    def lay_out(self) -> None:
        """Bring what the home says of the catalog and the settings to the desk.

        Raises:
            NotFoundError: no map is there.
            CorruptError: objects that are too long to be such.
        """
        self.desk.mkdir(mode=0o700, parents=True, exist_ok=True)
        (self.desk / "arrays").mkdir(exist_ok=True)
        for name in _FILES:
            try:
                content = self._small(name)
            except NotFoundError:
                if name == trust.URL_FILE:
                    raise NotFoundError(
                        f"no map at {self.url}: make one with gsmap init {self.url}", code="map_not_found"
                    ) from None
                (self.desk / name).unlink(missing_ok=True)
                continue
            if not (self.desk / name).is_file() or (self.desk / name).read_bytes() != content:
                write_whole(self.desk / name, partial(_write, content))

    def claim(self, folder: Path) -> bool:
        """Say that a map is here, whose ``catalog.url`` lies in a folder; False where one is here already."""
        return self.place.put_new(trust.URL_FILE, (folder / trust.URL_FILE).read_bytes())

    def send_settings(self) -> None:
        """Let the home have the settings of the desk."""
        path = self.desk / SETTINGS
        if path.is_file():
            content = path.read_bytes()
            self.place.put(SETTINGS, [content], len(content))
        else:
            self.place.delete(SETTINGS)

    def send(self, name: str, path: Path) -> None:
        """Send a file that is named by its content."""
        if self.place.size_bytes(name) != path.stat().st_size:
            self.place.put(name, chunks_of(path), path.stat().st_size)

    def bring(self, name: str) -> None:
        """Bring a file that is named by its content to the desk, unless it is there.

        Raises:
            NotFoundError: the home has none.
            CorruptError: such a name would lead elsewhere.
        """
        folder, _, file = name.partition("/")
        if "/" in name.replace("/", "", 1) or {folder, file} & {"", ".", ".."}:
            raise CorruptError(
                f"{self.url} has no file called {name!r}: nothing is done with it", code="invalid_stored_name"
            )
        target = self.desk / name
        if not target.is_file():
            target.parent.mkdir(exist_ok=True)
            write_whole(target, lambda staged: _fill(staged, self.place.get(name)))

    def _small(self, name: str) -> bytes:
        out = b""
        for chunk in self.place.get(name):
            out += chunk
            if len(out) > _MAX_BYTES:
                raise CorruptError(
                    f"{self.url}/{name} is far too long: gsmap did not write that", code="file_too_large"
                )
        return out


def _write(content: bytes, path: Path) -> None:
    path.write_bytes(content)


def _fill(path: Path, chunks: Iterator[bytes]) -> None:
    with open(path, "xb") as file:
        for chunk in chunks:
            file.write(chunk)

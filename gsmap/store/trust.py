"""Know the catalog servers that this user has named or trusted.

A map may come from an untrusted source, and its ``catalog.url`` would make gsmap connect to any server with the user's
password (``PGPASSWORD``, ``~/.pgpass``). So a stored URL is used only if the user created the map with it, ran ``gsmap
trust``, or set the environment variable `ENVIRONMENT`. Trust is stored in the user's configuration, by map id and exact
URL without password.
"""

from __future__ import annotations

import json
import logging
import os
import re
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError

from gsmap import platform
from gsmap.durable import open_file, write_whole
from gsmap.errors import MALFORMED, CorruptError, StoreError
from gsmap.store.column_types import is_digest
from gsmap.store.error_translation import display_name
from gsmap.texts import control_characters

_log = logging.getLogger("gsmap.store")

ENVIRONMENT = "GSMAP_CATALOG"
URL_FILE = "catalog.url"
_MAX_BYTES = 4096  # maximum size of a catalog.url
_DRIVER = re.compile(r"postgresql(\+[a-z0-9]+)?")


@dataclass(frozen=True)
class CatalogAddress:
    """The catalog of a map on a server.

    Args:
        url: of the database, without password.
        map_id: of the map in it; None in maps that an older gsmap made.
    """

    url: str
    map_id: str | None

    @property
    def server(self) -> str:
        """Return the host and port, or the socket folder, of the server."""
        url = make_url(self.url)
        hosts = [url.host, *_listed(url.query.get("host")), *_listed(url.query.get("hostaddr"))]
        named = ", ".join(host for host in hosts if host) or "this machine"
        port = url.port or ", ".join(_listed(url.query.get("port")))
        return f"{named}, port {port}" if port else named

    @property
    def database(self) -> str:
        return make_url(self.url).database or ""

    @property
    def user(self) -> str:
        return make_url(self.url).username or ""


def read_address(folder: Path) -> CatalogAddress:
    """Read a map's ``catalog.url``, without connecting.

    Raises:
        CorruptError: not a plain file, or not the URL of a PostgreSQL database.
    """
    path = folder / URL_FILE
    with open(open_file(path), "rb") as file:
        content = file.read(_MAX_BYTES + 1)
    try:
        lines = content.decode().splitlines()
        url = make_url(lines[0])
        fits = len(content) <= _MAX_BYTES and len(lines) <= 2 and not control_characters(lines[0])
        fits = fits and _DRIVER.fullmatch(url.drivername) is not None and (len(lines) < 2 or is_digest(lines[1]))
    except (ArgumentError, ValueError, IndexError):
        fits = False
    if not fits:
        raise CorruptError(
            f"{display_name(folder)}/{URL_FILE} does not name a PostgreSQL database (postgresql+psycopg://...), and "
            f"gsmap writes nothing else there: name the catalog in {ENVIRONMENT}, and do not trust the map if you "
            "received it like this",
            code="catalog_invalid",
        )
    return CatalogAddress(lines[0], lines[1] if len(lines) > 1 else None)


def write(folder: Path, url: str, map_id: str) -> None:
    """Write a map's ``catalog.url``: the URL (without password) and the map's id, one per line."""
    text = f"{url}\n{map_id}\n"
    write_whole(folder / URL_FILE, lambda staged: staged.write_text(text, encoding="utf-8"))


def catalog_url(folder: Path) -> str:
    """Return the URL of a map's catalog: from the environment, or the URL stored in the map if the user trusts it.

    Raises:
        StoreError: the user has neither named nor trusted it.
        CorruptError: see `read_address`.
    """
    if named := os.environ.get(ENVIRONMENT):
        return named
    found = read_address(folder)
    if is_trusted(found):
        return found.url
    raise StoreError(
        f"{display_name(folder)} would connect to {found.server} (database {found.database!r}, user {found.user!r}), "
        f"which you have not trusted yet: run gsmap trust {display_name(folder)} if that is correct, or name the "
        f"catalog's URL in {ENVIRONMENT}",
        code="untrusted_catalog",
    )


def is_trusted(found: CatalogAddress) -> bool:
    """Return True if this user trusts the exact URL of a map.

    Raises:
        StoreError: as `trusted_urls`.
    """
    return found.map_id is not None and found.url in trusted_urls().get(found.map_id, ())


def trusted_urls() -> dict[str, tuple[str, ...]]:
    """Return the URLs (without password) that this user trusts, by map id; a restored map has the id of its original.

    Raises:
        StoreError: the file of trusted URLs cannot be read.
    """
    path = config_file()
    try:
        found = json.loads(path.read_text(encoding="utf-8"))["catalogs"]
        # older files have one URL instead of a list
        known = {key: (urls,) if isinstance(urls, str) else tuple(urls) for key, urls in found.items()}
        if not all(isinstance(key, str) and all(isinstance(url, str) for url in known[key]) for key in known):
            raise TypeError("it must be a JSON object that maps ids to URLs")
    except FileNotFoundError:
        return {}
    except (OSError, *MALFORMED) as error:
        raise StoreError(
            f"{path} cannot be read ({error}): repair it, or remove it and run gsmap trust for your maps again",
            code="trust_file_unreadable",
        ) from error
    return known


def trust(map_id: str, url: str) -> None:
    """Store that this user trusts a URL (without password) as the catalog of a map."""
    path = config_file()
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        handle = os.open(path.parent, os.O_RDONLY | os.O_CLOEXEC)
        try:
            platform.lock(handle)  # concurrent updates would lose one
            known = trusted_urls()
            known[map_id] = tuple(dict.fromkeys((*known.get(map_id, ()), url)))
            text = json.dumps({"catalogs": known}, indent=1) + "\n"
            write_whole(path, lambda staged: _write_private(staged, text))
        finally:
            os.close(handle)
    except OSError as error:
        raise StoreError(
            f"cannot record in {path} that the catalog is trusted ({error.strerror}): name its URL in {ENVIRONMENT}",
            code="not_writable",
        ) from error


def trust_new_map(folder: Path) -> None:
    """Trust the catalog of a map that this user has just made; logs a warning if that cannot be stored."""
    found = read_address(folder)
    try:
        if found.map_id is not None:
            trust(found.map_id, found.url)
    except StoreError as error:  # the map exists and can be opened by naming its catalog
        _log.warning("%s", error)


def config_file() -> Path:
    """Return the path of this user's list of trusted catalogs."""
    base = os.environ.get("XDG_CONFIG_HOME") or "~/.config"
    return Path(base).expanduser() / "gsmap" / "catalogs.json"


def _write_private(path: Path, text: str) -> None:
    with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600), "wb") as file:
        file.write(text.encode())


def _listed(value: str | tuple[str, ...] | None) -> tuple[str, ...]:
    return () if value is None else (value,) if isinstance(value, str) else tuple(value)

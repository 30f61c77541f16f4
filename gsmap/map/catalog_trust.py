"""Report and trust the database server of a map."""

from __future__ import annotations

import os
from pathlib import Path

from gsmap.errors import ConfigError, NotFoundError
from gsmap.store import Store, remote_map
from gsmap.store import trust as trusting
from gsmap.store.error_translation import display_name
from gsmap.types.rows.trust import TrustReport


def catalog_of(path: str | os.PathLike[str]) -> TrustReport:
    """Report the server that a map names, and whether this user trusts that server, without connecting to it.

    Raises:
        NotFoundError: no such map.
        ConfigError: its catalog lies in its own folder.
        CorruptError: it names something else than a PostgreSQL database.
    """
    found = _remembered(_folder(path))
    return TrustReport(
        map=str(path),
        server=found.server,
        database=found.database,
        user=found.user,
        trusted=trusting.is_trusted(found),
    )


def trust(path: str | os.PathLike[str]) -> TrustReport:
    """Trust the server that a map names (``gsmap trust MAP``).

    Raises:
        NotFoundError, ConfigError, CorruptError: as `catalog_of`.
        StoreError: what the user trusts cannot be written down.
    """
    folder = _folder(path)
    found = _remembered(folder)
    map_id = found.map_id
    if map_id is None:  # made by an older gsmap: read the id from the database
        map_id = Store.id_at(path, found.url)
        trusting.write(folder, found.url, map_id)
    trusting.trust(map_id, found.url)
    return catalog_of(path)


def _folder(path: str | os.PathLike[str]) -> Path:
    """Return the folder of a map's ``catalog.url``; for an object store, the local mirror."""
    if not remote_map.is_remote(path):
        return remote_map.local_folder(path)
    home = remote_map.RemoteMap(os.fspath(path))
    home.refresh_mirror()
    return home.mirror


def _remembered(folder: Path) -> trusting.CatalogAddress:
    if not folder.is_dir():
        raise NotFoundError(f"no map at {display_name(folder)}", code="map_not_found")
    if not (folder / trusting.URL_FILE).exists():
        raise ConfigError(
            f"{folder} has no catalog.url: its catalog is in the folder, so there is no server to trust",
            code="nothing_to_trust",
        )
    return trusting.read_address(folder)

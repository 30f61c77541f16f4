"""The only door to a map's disk."""

from __future__ import annotations

import contextlib
import logging
import os
import stat
import uuid
from collections.abc import Iterator
from pathlib import Path

from sqlalchemy import insert, select

from gsmap.durable import sync_folder
from gsmap.errors import ConfigError, CorruptError, NotFoundError, StoreError
from gsmap.store import catalog as _catalog
from gsmap.store import integrity, migrate, schema, sqlite, staging, trust
from gsmap.store.arrays import Arrays
from gsmap.store.catalog import Catalog
from gsmap.store.exports import Exports
from gsmap.store.graphs import Graphs
from gsmap.store.integrity import Check, Pruned
from gsmap.store.models import Models
from gsmap.store.priors import Priors
from gsmap.store.recipes import Recipes
from gsmap.store.registrations import Registrations
from gsmap.store.revisions import Revisions
from gsmap.store.scenes import Scenes
from gsmap.types.progress import Progress
from gsmap.version import __version__

_log = logging.getLogger("gsmap.store")


class Store:
    """An open map: ``site.gsmap/map.sqlite`` (the catalog) and ``site.gsmap/arrays`` (immutable arrays).

    One attribute per noun: ``scenes``, ``recipes``, ``graphs``, ``registrations``, ``revisions``, ``priors``,
    ``models`` and ``exports``. Every method that changes something is one transaction, durable when it returns;
    `transaction` makes several of them one. Killed anywhere, the map opens whole. Threads may share a store; processes
    open their own.

    Example::

        with Store.create("site.gsmap") as store:
            scene, is_new = store.scenes.add(gaussians, cameras, name="monday")
    """

    def __init__(self, folder: Path, catalog: Catalog) -> None:
        self.folder = folder
        self.arrays = Arrays(folder / "arrays")
        self.catalog = catalog
        self.scenes = Scenes(catalog, self.arrays)
        self.recipes = Recipes(catalog)
        self.graphs = Graphs(catalog, self.arrays)
        self.registrations = Registrations(catalog)
        self.revisions = Revisions(catalog)
        self.priors = Priors(catalog)
        self.models = Models(catalog)
        self.exports = Exports(catalog)

    @classmethod
    def create(cls, path: str | os.PathLike[str], *, catalog_url: str | None = None) -> Store:
        """Make an empty map and open it for writing; it appears whole or not at all.

        Args:
            path: a folder that does not exist or is empty.
            catalog_url: an SQLAlchemy URL (an empty PostgreSQL database, for many writers) to use instead of
                ``map.sqlite``. It is remembered in ``catalog.url`` without its password, which the driver then takes
                from its usual places (``PGPASSWORD``, ``~/.pgpass``), and this user trusts it from now on.

        Raises:
            StoreError: the folder is not empty, or cannot be written.
            NotFoundError: the folder it should lie in does not exist.
        """
        folder = Path(path).absolute()
        if folder.is_dir() and any(folder.iterdir()):
            is_map = "is a map already" if _is_map(folder) else "is not empty"
            raise StoreError(f"{path} {is_map}: open it, or choose another name")
        if folder.exists() and not folder.is_dir():
            raise StoreError(f"{path} is a file: a map is a folder; choose another name")
        if not folder.parent.is_dir():
            raise NotFoundError(f"cannot make {path}: {folder.parent} does not exist")
        remembered: trust.Remembered | None = None
        with _catalog.explained(folder), staging.beside(folder) as staged:
            (staged / "arrays").mkdir()
            remembered = _make_catalog(staged, catalog_url)
            sync_folder(staged)
            os.rename(staged, folder)
            sync_folder(folder.parent)
        if remembered is not None and remembered.map_id is not None:
            try:
                trust.trust(remembered.map_id, remembered.url)
            except StoreError as error:  # the map is made; it is opened by naming its catalog again
                _log.warning("%s", error)
        return cls.open(path, "w", catalog_url=catalog_url)

    @classmethod
    def open(cls, path: str | os.PathLike[str], mode: str = "w", *, catalog_url: str | None = None) -> Store:
        """Open a map.

        Args:
            mode: ``r`` to read only (works on a read-only disk), ``w`` to change it too.
            catalog_url: in place of the remembered one, which is used only where the user trusts it
                (`gsmap.store.trust`).

        Raises:
            NotFoundError: no such folder.
            StoreError: not a map, not writable, or its catalog lies on a server that the user has not trusted.
            CorruptError: it holds links or other things that gsmap never puts there, or another map's catalog.
            SchemaVersionError: written by a newer gsmap, or an older one (``gsmap migrate``).
        """
        store = cls._connect(path, mode, catalog_url)
        try:
            migrate.require_current(store.catalog.engine, store.folder)
            if not store.catalog.is_sqlite:
                store._check_id()
        except BaseException:
            store.close()
            raise
        return store

    @classmethod
    def migrate(cls, path: str | os.PathLike[str]) -> tuple[str | None, str | None]:
        """Bring an older map to this gsmap's schema; returns the version before and after."""
        store = cls._connect(path, "w", None)
        with store:
            return migrate.upgrade(store.catalog)

    @classmethod
    def id_at(cls, path: str | os.PathLike[str], catalog_url: str) -> str:
        """The id of the map whose catalog is at a URL, whatever its schema; see `open` for the errors."""
        with cls._connect(path, "r", catalog_url) as store:
            return store.id

    @classmethod
    def _connect(cls, path: str | os.PathLike[str], mode: str, catalog_url: str | None) -> Store:
        if mode not in ("r", "w"):
            raise ConfigError(f"a store opens with mode 'r' or 'w', got {mode!r}")
        folder = Path(path)
        if not folder.exists():
            raise NotFoundError(f"no map at {path}: make one with gsmap init {path}")
        if not _is_map(folder):
            what = "lacks map.sqlite and arrays" if folder.is_dir() else "is a file"
            raise StoreError(f"{path} is not a gsmap map (it {what}): make one with gsmap init")
        _refuse_strange_entries(folder)
        if mode == "w" and not os.access(folder, os.W_OK):
            raise StoreError(f"{path} cannot be written (read-only disk or missing permission): open it for reading")
        with _catalog.explained(folder):
            if catalog_url is not None:
                engine = _catalog.url_engine(catalog_url)
            else:
                engine = _catalog.open_engine(folder, writable=mode == "w")
        return cls(folder, Catalog(folder, engine, writable=mode == "w"))

    @contextlib.contextmanager
    def transaction(self) -> Iterator[None]:
        """Everything inside is committed together at the end, or not at all. Keep it short: other writers wait."""
        with self.catalog.write():
            yield

    @property
    def id(self) -> str:
        """The map's own random id."""
        with self.catalog.read() as connection:
            return str(connection.execute(select(schema.about.c.id)).scalar_one())

    def _check_id(self) -> None:
        """Refuse a database that holds another map than the folder says."""
        known = trust.remembered(self.folder).map_id if (self.folder / trust.URL_FILE).exists() else None
        if known is not None and known != self.id:
            raise CorruptError(
                f"{self.folder} belongs to map {known[:12]}, but the database named for it holds map {self.id[:12]}: "
                f"name the right one in {trust.ENVIRONMENT}"
            )

    def check(self, progress: Progress | None = None) -> Check:
        """Read every byte of the map and compare it with what was written; see `gsmap.store.integrity.Check`."""
        return integrity.check(self.catalog, self.arrays, progress)

    def prune(self, *, keep_revisions: int | None = None, dry_run: bool = False) -> Pruned:
        """Reclaim what no kept revision names, and what crashes left; see `gsmap.store.integrity.prune`."""
        return integrity.prune(self.catalog, self.arrays, keep_revisions=keep_revisions, dry_run=dry_run)

    def close(self) -> None:
        self.catalog.close()

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"Store({str(self.folder)!r}, mode={'w' if self.catalog.writable else 'r'!r})"


def _is_map(folder: Path) -> bool:
    has_catalog = (folder / sqlite.FILE).is_file() or (folder / trust.URL_FILE).is_file()
    return has_catalog and (folder / "arrays").is_dir()


def _refuse_strange_entries(folder: Path) -> None:
    """Refuse a map with a link in it, which could make gsmap read or write elsewhere, or with a pipe or a device.

    The folder itself may be a link. What lies deeper is looked at where it is used.
    """
    with _catalog.explained(folder):
        for name in sorted(os.listdir(folder)):
            try:
                mode = os.lstat(folder / name).st_mode
            except FileNotFoundError:
                continue  # a file that was just replaced
            if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                what = "a link" if stat.S_ISLNK(mode) else "a pipe or a device"
                raise CorruptError(
                    f"{folder / name} is {what}: gsmap makes none in a map; put what belongs there in its place"
                )
    sqlite.refuse_super_journal(folder / sqlite.FILE)


def _make_catalog(folder: Path, url: str | None) -> trust.Remembered | None:
    map_id = uuid.uuid4().hex
    remembered: trust.Remembered | None = None
    if url is None:
        sqlite.create_file(folder / sqlite.FILE)
        engine = sqlite.engine(folder / sqlite.FILE, writable=True)
    else:
        engine = _catalog.url_engine(url)
        if migrate.version(engine, folder) is not None:
            raise StoreError(f"the database {engine.url!r} holds a map already: give each map a database of its own")
        remembered = trust.Remembered(_catalog.url_without_password(url), map_id)
        trust.write(folder, remembered.url, map_id)
    made = Catalog(folder, engine, writable=True)
    migrate.upgrade(made)
    with made.write() as connection:
        row = {"id": map_id, "created_at": _catalog.now(), "gsmap_version": __version__}
        connection.execute(insert(schema.about), row)
    made.close()
    return remembered

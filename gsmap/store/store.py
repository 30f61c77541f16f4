"""The only door to a map's disk."""

from __future__ import annotations

import contextlib
import os
import stat
import tempfile
import uuid
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from sqlalchemy import insert, select

from gsmap.durable import sync_folder
from gsmap.errors import ConfigError, CorruptError, NotFoundError, StoreError
from gsmap.store import branches, homes, integrity, migrate, schema, staging, trust
from gsmap.store import catalog as _catalog
from gsmap.store.arrays import Arrays, StoredFile
from gsmap.store.backups import Backups
from gsmap.store.branches import Branches, Place
from gsmap.store.catalog import Catalog
from gsmap.store.changes import Changes
from gsmap.store.copying import empty_catalog
from gsmap.store.explained import explained
from gsmap.store.exports import Exports
from gsmap.store.graphs import Graphs
from gsmap.store.homes import Home
from gsmap.store.indexes import Indexes
from gsmap.store.integrity import Check, Pruned
from gsmap.store.leases import Leases
from gsmap.store.models import Models
from gsmap.store.object_arrays import ObjectArrays
from gsmap.store.objects import Objects
from gsmap.store.photos import Photos
from gsmap.store.priors import Priors
from gsmap.store.recipes import Recipes
from gsmap.store.registrations import Registrations
from gsmap.store.revisions import Revisions
from gsmap.store.scenes import Scenes
from gsmap.store.set_aside import SetAsides
from gsmap.store.view_features import ViewFeatures
from gsmap.store.world import World
from gsmap.types.progress import Progress
from gsmap.version import __version__


class Store:
    """An open map: ``site.gsmap/map.sqlite`` (the catalog) and ``site.gsmap/arrays`` (immutable arrays).

    One attribute per noun: ``scenes``, ``recipes``, ``graphs``, ``indexes``, ``view_features``, ``photos``,
    ``registrations``, ``changes``, ``revisions``, ``priors``, ``world``, ``models``, ``exports``, ``branches``,
    ``backups``, ``leases`` and ``set_aside``. Every method that changes something is one transaction, durable when it
    returns; `transaction` makes several of them one. Killed anywhere, the map opens whole. Threads may share a store;
    processes open their own.

    A map may have branches (`gsmap.store.branches`): other catalogs over the same arrays.

    Args:
        place: ``home`` is the map's folder, with arrays and models; ``folder`` is where this catalog, its
            ``settings.toml`` and its writer lock lie: the same, or that of a branch; ``location`` opens it again.
        catalog: open on the database.

    Example::

        with Store.create("site.gsmap") as store:
            scene, is_new = store.scenes.add(gaussians, cameras, name="monday")
    """

    def __init__(self, place: Place, catalog: Catalog) -> None:
        self.home = place.home
        self.folder = place.folder
        self.branch = place.branch
        self.location = place.location
        self.is_tag = place.is_tag
        self._remote = place.remote
        self.arrays = Arrays(place.home / "arrays")
        if place.remote is not None:
            self.arrays = ObjectArrays(place.remote, catalog.arrays_lock)
        self.catalog = catalog
        self.scenes = Scenes(catalog, self.arrays)
        self.recipes = Recipes(catalog)
        self.graphs = Graphs(catalog, self.arrays)
        self.indexes = Indexes(catalog, self.arrays)
        self.view_features = ViewFeatures(catalog, self.arrays)
        self.photos = Photos(catalog, self.arrays)
        self.registrations = Registrations(catalog)
        self.changes = Changes(catalog, self.arrays)
        self.objects = Objects(catalog)
        self.revisions = Revisions(catalog)
        self.priors = Priors(catalog)
        self.world = World(catalog)
        self.models = Models(catalog, self.arrays)
        self.exports = Exports(catalog)
        self.branches = Branches(place, catalog, self.arrays)
        self.backups = Backups(catalog)
        self.leases = Leases(catalog)
        self.set_aside = SetAsides(catalog)

    @classmethod
    def create(cls, path: str | os.PathLike[str], *, catalog_url: str | None = None) -> Store:
        """Make an empty map and open it for writing; it appears whole or not at all.

        Args:
            path: a folder that does not exist or is empty, or ``s3://BUCKET/PREFIX`` where nothing is.
            catalog_url: an SQLAlchemy URL (an empty PostgreSQL database, for many writers) to use instead of
                ``map.sqlite``. It is remembered in ``catalog.url`` without its password, which the driver then takes
                from its usual places (``PGPASSWORD``, ``~/.pgpass``), and this user trusts it from now on.

        Raises:
            ConfigError: a bucket without a ``catalog_url``.
            StoreError: the folder or bucket is not empty, or cannot be written.
            NotFoundError: the folder it should lie in does not exist.
        """
        if (home := branches.find(path).remote) is not None:
            _claim(home, catalog_url)
            return cls.open(path, "w", catalog_url=catalog_url)
        folder = branches.find(homes.local(path).absolute()).folder
        if folder.is_dir() and any(folder.iterdir()):
            is_map = "is a map already" if branches.holds_catalog(folder) else "is not empty"
            raise StoreError(f"{path} {is_map}: open it, or choose another name", code="already_exists")
        if folder.exists() and not folder.is_dir():
            raise StoreError(f"{path} is a file: a map is a folder; choose another name", code="not_a_folder")
        if not folder.parent.is_dir():
            raise NotFoundError(f"cannot make {path}: {folder.parent} does not exist", code="folder_not_found")
        with explained(folder, "no map was made"), staging.beside(folder) as staged:
            (staged / "arrays").mkdir()
            _make_catalog(staged, catalog_url)
            sync_folder(staged)
            os.rename(staged, folder)
            sync_folder(folder.parent)
        if catalog_url is not None:
            trust.remember(folder)
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
            migrate.require_current(store.catalog)
            if not store.catalog.is_sqlite:
                store._check_id()
        except BaseException:
            store.close()
            raise
        return store

    @staticmethod
    def exists(path: str | os.PathLike[str]) -> bool:
        """Whether anything lies there, or the branch does that a path names.

        Raises:
            NotFoundError: the path names a branch that its map lacks.
        """
        place = branches.find(path)
        return place.folder.exists() if place.remote is None else place.remote.exists()

    @staticmethod
    def can_write(path: str | os.PathLike[str]) -> bool:
        """Whether `open` with mode ``w`` makes sense there: not of a read-only folder, and not of a tag."""
        place = branches.find(path)
        if place.remote is not None:
            return True
        return not place.is_tag and (not place.folder.is_dir() or os.access(place.folder, os.W_OK))

    @classmethod
    def open_even_tag(cls, path: str | os.PathLike[str]) -> Store:
        """Open for writing, a tag as well: what is purged goes from there, too."""
        store = cls._connect(path, "w", None, even_tags=True)
        try:
            migrate.require_current(store.catalog)
        except BaseException:
            store.close()
            raise
        return store

    def others(self) -> list[Place]:
        """Where the other catalogs over the same arrays lie: the map, its branches, its tags."""
        return branches.other_places(self.home, self.folder)

    @classmethod
    def migrate(cls, path: str | os.PathLike[str]) -> tuple[str | None, str | None]:
        """Bring an older map (and its branches and tags) to this gsmap's schema; the version before and after."""
        with cls._connect(path, "w", None, even_tags=True) as store:
            versions = migrate.upgrade(store.catalog)
        for place in branches.places(store.home) if not store.branch else ():
            with cls._connect(place.location, "w", None, even_tags=True) as branch:
                migrate.upgrade(branch.catalog)
        return versions

    @classmethod
    def accept_catalog(cls, path: str | os.PathLike[str]) -> list[str]:
        """Take a catalog that differs from what was written as it is, and note new digests: what differed, in words.

        For salvage: SQLite must find it sound, but nobody knows whether its values are those that were written.

        Raises:
            CorruptError: SQLite cannot make sense of it.
            ConfigError: the catalog is no file of the map.
        """
        with cls._connect(path, "w", None, verify=False, even_tags=True) as store:
            return store.catalog.accept()

    @classmethod
    def id_at(cls, path: str | os.PathLike[str], catalog_url: str) -> str:
        """The id of the map whose catalog is at a URL, whatever its schema; see `open` for the errors."""
        with cls._connect(path, "r", catalog_url) as store:
            return store.id

    @classmethod
    def _connect(
        cls,
        path: str | os.PathLike[str],
        mode: str,
        catalog_url: str | None,
        *,
        even_tags: bool = False,
        verify: bool = True,
    ) -> Store:
        if mode not in ("r", "w"):
            raise ConfigError(f"a store opens with mode 'r' or 'w', got {mode!r}", code="invalid_choice")
        place = branches.find(path)
        folder = place.folder
        if place.remote is not None:
            place.remote.lay_out()
        if not folder.exists():
            raise NotFoundError(f"no map at {path}: make one with gsmap init {path}", code="map_not_found")
        if not branches.is_map(place.home):
            what = "lacks map.sqlite and arrays" if folder.is_dir() else "is a file"
            raise StoreError(f"{path} is not a gsmap map (it {what}): make one with gsmap init", code="not_a_map")
        _refuse_strange_entries(place.home)
        _refuse_strange_entries(folder)
        refusal = f"{path} is a tag, which does not change: make a branch of it (gsmap branch {path} NAME)"
        if mode == "w" and place.is_tag and not even_tags:
            raise StoreError(refusal, code="catalog_refused")
        if mode == "w" and not os.access(folder, os.W_OK):
            raise StoreError(
                f"{path} cannot be written (read-only disk or missing permission): open it for reading",
                code="not_writable",
            )
        with explained(folder):
            if catalog_url is not None:
                engine = _catalog.url_engine(catalog_url)
            else:
                engine = _catalog.open_engine(folder, writable=mode == "w")
        store = cls(place, Catalog(folder, engine, writable=mode == "w", refusal=refusal if place.is_tag else ""))
        try:
            if verify:
                store.catalog.verify()
        except BaseException:
            store.catalog.close(fold=False)
            raise
        return store

    @contextlib.contextmanager
    def transaction(self) -> Iterator[None]:
        """Everything inside is committed together at the end, or not at all. Keep it short: other writers wait."""
        with self.catalog.write():
            yield

    def send_settings(self) -> None:
        """Let the home have ``settings.toml`` as it is now; in a folder it is there already."""
        if self._remote is not None:
            self._remote.send_settings()

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
                f"name the right one in {trust.ENVIRONMENT}",
                code="wrong_catalog",
            )

    def check(self, progress: Progress | None = None) -> Check:
        """Read every byte of the map and compare it with what was written; see `gsmap.store.integrity.Check`.

        With the map itself its branches and tags are checked, too; a branch alone where that is what is open.
        """
        read: set[tuple[str, tuple[StoredFile, ...]]] = set()
        found = integrity.check(
            self.catalog, self.arrays, progress, read=read, location=None if self.is_tag else self.location
        )
        for place in branches.places(self.home) if not self.branch else ():
            try:
                with Store.open(place.location, "r") as other:
                    more = integrity.check(
                        other.catalog,
                        other.arrays,
                        progress,
                        read=read,
                        location=None if place.is_tag else place.location,
                    )
            except StoreError as error:
                more = Check((str(error),), (), 0, 0)
            problems = tuple(f"{place.branch}: {problem}" for problem in more.problems)
            found = replace(
                found,
                problems=found.problems + problems,
                num_groups=found.num_groups + more.num_groups,
                num_bytes=found.num_bytes + more.num_bytes,
            )
        return found

    def prune(self, *, keep_revisions: int | None = None, dry_run: bool = False) -> Pruned:
        """Reclaim what no kept revision names, and what crashes left; see `gsmap.store.integrity.prune`."""
        return integrity.prune(self.catalog, self.arrays, keep_revisions=keep_revisions, dry_run=dry_run)

    def reclaim(self) -> integrity.Reclaimed:
        """Delete arrays and models that no row names, and what crashes left."""
        return integrity.reclaim(self.catalog, self.arrays)

    def close(self) -> None:
        self.leases.close()
        self.catalog.close()

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"Store({self.location!r}, mode={'w' if self.catalog.writable else 'r'!r})"


def _refuse_strange_entries(folder: Path) -> None:
    """Refuse a map with a link in it, which could make gsmap read or write elsewhere, or with a pipe or a device.

    The folder itself may be a link. What lies deeper is looked at where it is used.
    """
    with explained(folder):
        for name in sorted(os.listdir(folder)):
            try:
                mode = os.lstat(folder / name).st_mode
            except FileNotFoundError:
                continue  # a file that was just replaced
            if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                what = "a link" if stat.S_ISLNK(mode) else "a pipe or a device"
                raise CorruptError(
                    f"{folder / name} is {what}: gsmap makes none in a map; put what belongs there in its place",
                    code="not_a_plain_file",
                )


def _claim(home: Home, catalog_url: str | None) -> None:
    """Make an empty map in a bucket."""
    if catalog_url is None:
        raise ConfigError(
            f"{home.url} is a bucket, which can hold no catalog: name an empty PostgreSQL database (gsmap init "
            f"{home.url} --catalog postgresql+psycopg://...)",
            code="bucket_needs_catalog",
        )
    if home.exists():
        raise StoreError(f"{home.url} is a map already: open it, or choose another name", code="already_exists")
    if (found := home.place.anything()) is not None:
        raise StoreError(f"{home.url} is not empty (it has {found}): choose another name", code="folder_not_empty")
    with tempfile.TemporaryDirectory(prefix="gsmap-") as folder:
        _make_catalog(Path(folder), catalog_url)
        if not home.claim(Path(folder)):
            raise StoreError(
                f"another process made a map at {home.url} meanwhile: open it, or choose another name",
                code="already_exists",
            )
        trust.remember(Path(folder))


def _make_catalog(folder: Path, url: str | None) -> None:
    map_id = uuid.uuid4().hex
    made = empty_catalog(folder, url, map_id)
    with made.write() as connection:
        row = {"id": map_id, "created_at": _catalog.now(), "gsmap_version": __version__}
        connection.execute(insert(schema.about), row)
    made.close()

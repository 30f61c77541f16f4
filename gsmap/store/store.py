"""Open, create, check and prune a map on disk."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import stat
import tempfile
import uuid
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from sqlalchemy import func, insert, select

from gsmap.durable import sync_folder
from gsmap.errors import ConfigError, CorruptError, NotFoundError, SchemaVersionError, StoreError
from gsmap.store import branches, integrity, migrate, remote_map, schema, sqlite, staging, trust
from gsmap.store import catalog as _catalog
from gsmap.store.arrays import Arrays, StoredFile
from gsmap.store.backups import Backups
from gsmap.store.branches import Branches, MapLocation
from gsmap.store.catalog import Catalog
from gsmap.store.catalog_copy import drop_tables, empty_catalog, open_sqlite_catalog
from gsmap.store.catalog_rows import locate_all
from gsmap.store.changes import Changes
from gsmap.store.error_translation import set_display_name, translate_errors
from gsmap.store.exports import Exports
from gsmap.store.graphs import Graphs
from gsmap.store.indexes import Indexes
from gsmap.store.leases import Leases
from gsmap.store.models import Models
from gsmap.store.object_arrays import ObjectArrays
from gsmap.store.objects import Objects
from gsmap.store.photos import Photos
from gsmap.store.priors import Priors
from gsmap.store.quarantine import Quarantine
from gsmap.store.recipes import Recipes
from gsmap.store.registrations import Registrations
from gsmap.store.remote_map import RemoteMap
from gsmap.store.revisions import Revisions
from gsmap.store.scenes import Scenes
from gsmap.store.world import WorldObservations
from gsmap.types.progress import Progress
from gsmap.types.rows.maps import CheckReport, PruneReport
from gsmap.version import __version__

if TYPE_CHECKING:
    from gsmap.store.prepared_scenes import PreparedScenes
    from gsmap.store.view_features import ViewFeatures

_log = logging.getLogger("gsmap.store")
_WRITTEN = (
    *(schema.scenes.c.ingested_at, schema.scenes.c.removed_at, schema.scene_facts.c.created_at),
    *(schema.registrations.c.created_at, schema.reviews.c.created_at, schema.revisions.c.created_at),
    *(schema.comparisons.c.created_at, schema.exports.c.created_at),
)


class Store:
    """An open map: ``site.gsmap/map.sqlite`` (the catalog) and ``site.gsmap/arrays`` (immutable arrays).

    One attribute per noun: ``scenes``, ``recipes``, ``graphs``, ``indexes``, ``view_features``, ``prepared_scenes``,
    ``photos``, ``registrations``, ``changes``, ``revisions``, ``priors``, ``world``, ``models``, ``exports``,
    ``branches``, ``backups``, ``leases`` and ``set_aside``. Every method that changes something is one transaction,
    durable when it returns; `transaction` makes several of them one. Killed anywhere, the map opens whole. Threads may
    share a store; processes open their own.

    A map may have branches (`gsmap.store.branches`): other catalogs over the same arrays.

    Args:
        place: ``home`` is the map's folder, with arrays and models; ``folder`` is where this catalog, its
            ``settings.toml`` and its writer lock lie: the same, or that of a branch; ``location`` opens it again.
        catalog: open on the database.

    Example::

        with Store.create("site.gsmap") as store:
            scene, is_new = store.scenes.add(gaussians, cameras, name="monday")
    """

    def __init__(self, place: MapLocation, catalog: Catalog) -> None:
        self._place = place
        self._copied: tempfile.TemporaryDirectory[str] | None = None
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
        self.photos = Photos(catalog, self.arrays)
        self.registrations = Registrations(catalog)
        self.changes = Changes(catalog, self.arrays)
        self.objects = Objects(catalog)
        self.revisions = Revisions(catalog)
        self.priors = Priors(catalog)
        self.world = WorldObservations(catalog)
        self.models = Models(catalog, self.arrays)
        self.exports = Exports(catalog)
        self.branches = Branches(place, catalog, self.arrays)
        self.backups = Backups(catalog)
        self.leases = Leases(catalog)
        self.quarantine = Quarantine(catalog)

    def located(self) -> contextlib.AbstractContextManager[None]:
        """Look up all scenes and graphs at once, for verbs that read many of them; see `gsmap.store.catalog_rows`."""
        return locate_all(self.catalog)

    @cached_property
    def view_features(self) -> ViewFeatures:
        """Features of the views of each scene."""
        from gsmap.store.view_features import ViewFeatures  # imported here, as verbs that only read rows do not need it

        return ViewFeatures(self.catalog, self.arrays)

    @cached_property
    def prepared_scenes(self) -> PreparedScenes:
        """Preparation of each scene for its registrations."""
        from gsmap.store.prepared_scenes import PreparedScenes

        return PreparedScenes(self.catalog, self.arrays)

    @classmethod
    def create(cls, path: str | os.PathLike[str], *, catalog_url: str | None = None) -> Store:
        """Create an empty map and open it for writing; after an error, no partial map remains.

        Args:
            path: a folder that does not exist or is empty, or an empty ``s3://BUCKET/PREFIX``.
            catalog_url: SQLAlchemy URL of an empty PostgreSQL database (for many writers) to use instead of
                ``map.sqlite``. It is stored in ``catalog.url`` without its password, which the driver takes from its
                usual places (``PGPASSWORD``, ``~/.pgpass``), and is trusted by this user from now on.

        Raises:
            ConfigError: a remote map without a ``catalog_url``.
            StoreError: the folder or bucket is not empty, or not writable.
            NotFoundError: the parent folder does not exist.
        """
        if (home := branches.locate(path).remote) is not None:
            _claim(home, catalog_url)
            return cls.open(path, "w", catalog_url=catalog_url)
        folder = branches.locate(remote_map.local_folder(path).absolute()).folder
        if folder.is_dir() and any(folder.iterdir()):
            is_map = "is a map already" if branches.has_catalog(folder) else "is not empty"
            raise StoreError(f"{path} {is_map}: open it, or choose another name", code="already_exists")
        if folder.exists() and not folder.is_dir():
            raise StoreError(f"{path} is a file, but a map needs a folder: choose another name", code="not_a_folder")
        if not folder.parent.is_dir():
            raise NotFoundError(f"cannot make {path}: {folder.parent} does not exist", code="folder_not_found")
        with (
            translate_errors(folder, "no map was made"),
            staging.beside(folder) as staged,
            contextlib.ExitStack() as undo,
        ):
            (staged / "arrays").mkdir()
            _make_catalog(staged, catalog_url, undo)
            sync_folder(staged)
            try:
                os.rename(staged, folder)
            except OSError as error:
                if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                    raise
                raise StoreError(f"{path} was made by another process meanwhile", code="already_exists") from error
            undo.pop_all()
            sync_folder(folder.parent)
        if catalog_url is not None:
            trust.trust_new_map(folder)
        return cls.open(path, "w", catalog_url=catalog_url)

    @classmethod
    def open(cls, path: str | os.PathLike[str], mode: str = "w", *, catalog_url: str | None = None) -> Store:
        """Open a map.

        Args:
            mode: ``r`` to read only (works on a read-only disk), ``w`` to change it too.
            catalog_url: used instead of the stored URL, which is used only if the user trusts it (`gsmap.store.trust`).

        Raises:
            NotFoundError: no such folder.
            StoreError: not a map, not writable, or its catalog is on a server that the user has not trusted.
            CorruptError: it holds links or other entries that gsmap never makes, or another map's catalog.
            SchemaVersionError: written by a newer gsmap, or an older one (``gsmap migrate``); a map of an older release
                with an SQLite catalog can be read.
        """
        store = cls._connect(path, mode, catalog_url)
        try:
            try:
                migrate.require_current(store.catalog)
            except SchemaVersionError as error:
                if mode == "w" or error.code != "map_too_old" or not store.catalog.is_sqlite:
                    raise
                return store._migrated_copy()
            if not store.catalog.is_sqlite:
                store._check_id()
        except BaseException:
            store.close()
            raise
        return store

    @staticmethod
    def exists(path: str | os.PathLike[str]) -> bool:
        """Return True if the path, or the branch that it names, exists.

        Raises:
            NotFoundError: the path names a branch that its map lacks.
        """
        place = branches.locate(path)
        return place.folder.exists() if place.remote is None else place.remote.exists()

    @staticmethod
    def can_write(path: str | os.PathLike[str]) -> bool:
        """Return True unless the path is a read-only folder or a tag."""
        place = branches.locate(path)
        if place.remote is not None:
            return True
        return not place.is_tag and (not place.folder.is_dir() or os.access(place.folder, os.W_OK))

    @classmethod
    def open_writable(cls, path: str | os.PathLike[str]) -> Store:
        """Open a map, a branch or even a tag for writing, as a purge needs it."""
        store = cls._connect(path, "w", None, allow_tags=True)
        try:
            migrate.require_current(store.catalog)
        except BaseException:
            store.close()
            raise
        return store

    def others(self) -> list[MapLocation]:
        """Return the locations of all other catalogs for the same arrays: the map, its branches and its tags."""
        return branches.other_locations(self.home, self.folder)

    @classmethod
    def migrate(cls, path: str | os.PathLike[str]) -> tuple[str | None, str | None]:
        """Migrate an older map, its branches and tags to the current schema; return the versions before and after."""
        with cls._connect(path, "w", None, allow_tags=True) as store:
            versions = migrate.upgrade(store.catalog)
        for place in branches.branch_locations(store.home) if not store.branch else ():
            with cls._connect(place.location, "w", None, allow_tags=True) as branch:
                migrate.upgrade(branch.catalog)
        return versions

    @classmethod
    def accept_catalog(cls, path: str | os.PathLike[str]) -> list[str]:
        """Accept a catalog that differs from its page digests, write new digests, and return the differences.

        For salvage: SQLite must find it sound, but its values may differ from those that were written.

        Raises:
            CorruptError: SQLite finds the catalog damaged.
            ConfigError: the catalog is not a file of the map.
        """
        with cls._connect(path, "w", None, verify=False, allow_tags=True) as store:
            return store.catalog.accept()

    @classmethod
    def id_at(cls, path: str | os.PathLike[str], catalog_url: str) -> str:
        """Return the id of the map whose catalog is at a URL, for any schema; raise the same errors as `open`."""
        with cls._connect(path, "r", catalog_url) as store:
            return store.id

    @classmethod
    def _connect(
        cls,
        path: str | os.PathLike[str],
        mode: str,
        catalog_url: str | None,
        *,
        allow_tags: bool = False,
        verify: bool = True,
    ) -> Store:
        if mode not in ("r", "w"):
            raise ConfigError(f"the mode of a store must be 'r' or 'w', got {mode!r}", code="invalid_choice")
        place = branches.locate(path)
        folder = place.folder
        if place.remote is not None:
            place.remote.refresh_mirror()
        if not folder.exists():
            raise NotFoundError(f"no map at {path}: create one with gsmap init {path}", code="map_not_found")
        if not branches.is_map(place.home):
            what = "lacks map.sqlite and arrays" if folder.is_dir() else "is a file"
            raise StoreError(f"{path} is not a gsmap map (it {what}): create one with gsmap init", code="not_a_map")
        _refuse_unexpected_entries(place.home)
        _refuse_unexpected_entries(folder)
        read_only_message = f"{path} is a tag and cannot be changed: create a branch of it (gsmap branch {path} NAME)"
        if mode == "w" and place.is_tag and not allow_tags:
            raise StoreError(read_only_message, code="not_writable")
        if mode == "w" and not os.access(folder, os.W_OK):
            raise StoreError(
                f"{path} cannot be written (read-only disk or missing permission): open it for reading",
                code="not_writable",
            )
        with translate_errors(folder):
            if catalog_url is not None:
                engine = _catalog.url_engine(catalog_url)
            else:
                engine = _catalog.open_engine(folder, writable=mode == "w")
        store = cls(
            place,
            Catalog(folder, engine, writable=mode == "w", read_only_message=read_only_message if place.is_tag else ""),
        )
        try:
            if verify:
                store.catalog.verify()
        except BaseException:
            store.catalog.close(fold=False)
            raise
        return store

    @contextlib.contextmanager
    def transaction(self) -> Iterator[None]:
        """Commit all changes of the block together, or none. Keep the block short, as other writers wait for it."""
        with self.catalog.write():
            yield

    def time_written(self) -> str | None:
        """Return the time of the map's newest row, ISO 8601; None for an empty map."""
        with self.catalog.read() as connection:
            newest = [connection.execute(select(func.max(column))).scalar() for column in _WRITTEN]
        return max((str(when) for when in newest if when), default=None)

    def upload_settings(self) -> None:
        """Upload ``settings.toml`` of a remote map; does nothing for a local map."""
        if self._remote is not None:
            self._remote.upload_settings()

    @property
    def id(self) -> str:
        """Return the random id of the map."""
        with self.catalog.read() as connection:
            return str(connection.execute(select(schema.about.c.id)).scalar_one())

    def _check_id(self) -> None:
        """Raise an error if the database has another map than ``catalog.url`` names."""
        known = trust.read_address(self.folder).map_id if (self.folder / trust.URL_FILE).exists() else None
        if known is not None and known != self.id:
            raise CorruptError(
                f"{self.folder} belongs to map {known[:12]}, but its database holds map {self.id[:12]}: "
                f"name the right one in {trust.ENVIRONMENT}",
                code="wrong_catalog",
            )

    def check(self, progress: Progress | None = None) -> CheckReport:
        """Read every byte of the map and compare it with its digests; see `gsmap.store.integrity.check`.

        Checks the branches and tags of a map, too, but only the branch if one is open.
        """
        read: set[tuple[str, tuple[StoredFile, ...]]] = set()
        found = integrity.check(
            self.catalog, self.arrays, progress, read=read, location=None if self.is_tag else self.location
        )
        for place in branches.branch_locations(self.home) if not self.branch else ():
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
                more = CheckReport(ok=False, problems=(str(error),))
            problems = tuple(f"{place.branch}: {problem}" for problem in more.problems)
            found = replace(
                found,
                ok=found.ok and more.ok,
                problems=found.problems + problems,
                num_groups=found.num_groups + more.num_groups,
                num_bytes=found.num_bytes + more.num_bytes,
            )
        return found

    def prune(self, *, keep_revisions: int | None = None, dry_run: bool = False) -> PruneReport:
        """Reclaim arrays that no kept revision uses, and leftovers of crashes; see `gsmap.store.integrity.prune`."""
        return integrity.prune(self.catalog, self.arrays, keep_revisions=keep_revisions, dry_run=dry_run)

    def reclaim(self) -> integrity.ReclaimResult:
        """Delete arrays and models that no row names, and leftovers of crashes."""
        return integrity.reclaim(self.catalog, self.arrays)

    def _migrated_copy(self) -> Store:
        """Return a store that reads a migrated copy of this older catalog; closes this store."""
        copied = tempfile.TemporaryDirectory(prefix="gsmap_", ignore_cleanup_errors=True)
        folder = Path(copied.name)
        set_display_name(folder, self.location)
        with contextlib.closing(self):
            self.catalog.copy(folder / sqlite.FILE)
        with contextlib.closing(open_sqlite_catalog(folder)) as catalog:
            found, _ = migrate.upgrade(catalog)
        message = (
            f"{self.location} was written by an older gsmap (schema {found}): run gsmap migrate {self.location} to "
            "change it"
        )
        _log.info("reading a migrated copy of the catalog: %s", message)
        engine = _catalog.open_engine(folder, writable=False)
        store = Store(self._place, Catalog(folder, engine, writable=False, read_only_message=message))
        store._copied = copied
        migrate.require_current(store.catalog)
        return store

    def close(self) -> None:
        self.leases.close()
        self.catalog.close()
        if self._copied is not None:
            self._copied.cleanup()

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"Store({self.location!r}, mode={'w' if self.catalog.writable else 'r'!r})"


def _refuse_unexpected_entries(folder: Path) -> None:
    """Raise an error for a map that contains a link, which could redirect reads and writes, a pipe or a device.

    The folder itself may be a link. Deeper entries are checked when they are used.
    """
    with translate_errors(folder):
        for name in sorted(os.listdir(folder)):
            try:
                mode = os.lstat(folder / name).st_mode
            except FileNotFoundError:
                continue  # just replaced
            if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                what = "a link" if stat.S_ISLNK(mode) else "a pipe or a device"
                raise CorruptError(
                    f"{folder / name} is {what}, and gsmap creates none in a map: replace it by the original "
                    "file or folder",
                    code="not_a_plain_file",
                )


def _claim(home: RemoteMap, catalog_url: str | None) -> None:
    """Create an empty remote map."""
    if catalog_url is None:
        raise ConfigError(
            f"{home.url} is a bucket, which cannot hold a catalog: name an empty PostgreSQL database (gsmap init "
            f"{home.url} --catalog postgresql+psycopg://...)",
            code="bucket_needs_catalog",
        )
    if home.exists():
        raise StoreError(f"{home.url} is a map already: open it, or choose another name", code="already_exists")
    if (found := home.storage.first_name()) is not None:
        raise StoreError(f"{home.url} is not empty (it has {found}): choose another name", code="folder_not_empty")
    with tempfile.TemporaryDirectory(prefix="gsmap-") as folder, contextlib.ExitStack() as undo:
        _make_catalog(Path(folder), catalog_url, undo)
        if not home.claim(Path(folder)):
            raise StoreError(
                f"another process created a map at {home.url} meanwhile: open it, or choose another name",
                code="already_exists",
            )
        undo.pop_all()
        trust.trust_new_map(Path(folder))


def _make_catalog(folder: Path, url: str | None, undo: contextlib.ExitStack) -> None:
    """Create an empty catalog; ``undo`` empties its database again, so that another map can be made with it."""
    map_id = uuid.uuid4().hex
    made = empty_catalog(folder, url, map_id)
    with contextlib.closing(made), made.write() as connection:
        if connection.execute(select(schema.about.c.id)).first() is not None:
            raise StoreError(
                f"another process made a map in the database {made.engine.url!r} meanwhile: give each map a database "
                "of its own",
                code="database_not_empty",
            )
        row = {"id": map_id, "created_at": _catalog.now(), "gsmap_version": __version__}
        connection.execute(insert(schema.about), row)
    if url is not None:
        undo.callback(drop_tables, folder, url)

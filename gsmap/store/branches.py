"""Branches and tags: additional catalogs for the same arrays, which are opened as ``MAP@NAME``.

A branch is a folder ``MAP/branches/NAME`` with its own catalog, settings and writer lock; arrays and models are shared
with the map, so that making a branch copies no array. A tag is a read-only branch.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import re
import shutil
import uuid
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from sqlalchemy import Connection, func, select

from gsmap.durable import is_file, is_folder, make_folder, remove_tree, sync_file, sync_folder
from gsmap.errors import ConfigError, NotFoundError, StoreError
from gsmap.settings import FILE_NAME as SETTINGS
from gsmap.store import remote_map, sqlite, trust
from gsmap.store.arrays import Arrays, StoredFile
from gsmap.store.catalog import Catalog, now, open_engine
from gsmap.store.catalog_copy import copy_catalog, empty_catalog, make_independent
from gsmap.store.error_translation import displayed_as, translate_errors
from gsmap.store.remote_map import RemoteMap
from gsmap.store.schema import exports, files, groups, leases, models, revisions, scenes, set_aside, tiles

if TYPE_CHECKING:
    from gsmap.types.rows.map_operations import BranchRow

FOLDER = "branches"
MARKER = "branch.json"
_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,63}")  # used as a folder name
_LEFTOVER = re.compile(rf"\.{_NAME.pattern}\.[0-9a-f]{{8}}")
_log = logging.getLogger("gsmap.store")


@dataclass(frozen=True)
class MapLocation:
    """The location of a map or of a branch.

    Args:
        home: root folder of the map, with arrays and models.
        folder: folder of the catalog, ``settings.toml`` and the writer lock.
        branch: name of the branch or tag; empty for the map itself.
        is_tag: the catalog is read-only.
        remote: the remote map in an object store; ``home`` and ``folder`` are then its local mirror.
    """

    home: Path
    folder: Path
    branch: str = ""
    is_tag: bool = False
    remote: RemoteMap | None = None

    @property
    def location(self) -> str:
        """Return the string that opens this map or branch."""
        if self.remote is not None:
            return self.remote.url
        return f"{self.home}@{self.branch}" if self.branch else str(self.home)


def locate(path: str | os.PathLike[str]) -> MapLocation:
    """Resolve a path to a map, or ``MAP@NAME`` to a branch; an existing path always names a map.

    Raises:
        ConfigError: the map exists, but the text after ``@`` is not a valid branch name.
        NotFoundError: the map has no such branch.
    """
    if remote_map.is_remote(path):
        remote = RemoteMap(os.fspath(path))
        return MapLocation(remote.mirror, remote.mirror, remote=remote)
    folder = remote_map.local_folder(path)
    left, at, name = str(folder).rpartition("@")
    if folder.exists() or not at or "/" in name or not is_map(Path(left)):
        return MapLocation(folder, folder)
    home = Path(left)
    validated_name(name)
    for place in branch_locations(home):
        if place.branch == name:
            return place
    known = ", ".join(place.branch for place in branch_locations(home))
    there = f"it has {known}" if known else f"create it with gsmap branch {home} {name}"
    raise NotFoundError(f"{home} has no branch or tag {name!r}: {there}", code="branch_not_found")


def branch_locations(home: Path) -> list[MapLocation]:
    """Return the branches and tags of a map, by name."""
    root = home / FOLDER
    found = []
    for folder in sorted(root.iterdir()) if is_folder(root) else ():
        ours = _NAME.fullmatch(folder.name) and is_folder(folder) and is_file(folder / sqlite.FILE)
        if ours and is_file(folder / MARKER):
            found.append(MapLocation(home, folder, folder.name, _read_marker(folder)["kind"] == "tag"))
    return found


def unknown_entries(home: Path) -> list[str]:
    """Return the relative paths of entries in the branches folder that are neither branches nor leftovers of a crash.

    Each may be a branch that lost a file or its name, and may be the only catalog that names some arrays.
    """
    root = home / FOLDER
    if not os.path.lexists(root):
        return []
    if not is_folder(root):
        return [FOLDER]
    known = {place.branch for place in branch_locations(home)}
    return [f"{FOLDER}/{name}" for name in sorted(os.listdir(root)) if name not in known and not _is_leftover(name)]


def _is_leftover(name: str) -> bool:
    """Return True for the name of a branch folder that is being made or deleted, or that a crash left."""
    return _LEFTOVER.fullmatch(name) is not None


def other_locations(home: Path, folder: Path) -> list[MapLocation]:
    """Return the locations of all other catalogs for the same arrays: the map, its branches and its tags."""
    return [place for place in (MapLocation(home, home), *branch_locations(home)) if place.folder != folder]


def validated_name(name: str) -> str:
    """Return the name of a branch if it is valid; otherwise raise an error.

    Raises:
        ConfigError: the name is invalid.
    """
    if not _NAME.fullmatch(name):
        raise ConfigError(
            "the name of a branch or tag has up to 64 letters, digits, '.', '_' and '-', and does not begin with '.': "
            f"{name!r}",
            code="invalid_name",
        )
    return name


def is_map(folder: Path) -> bool:
    """Return True if a folder is a map."""
    return has_catalog(folder) and (folder / "arrays").is_dir()


def has_catalog(folder: Path) -> bool:
    """Return True if a folder has a catalog, as the folder of a map or a branch."""
    return (folder / sqlite.FILE).is_file() or (folder / trust.URL_FILE).is_file()


class Branches:
    """The branches and tags of a map.

    Args:
        place: the open map or branch, of which `make` makes a branch.
    """

    def __init__(self, place: MapLocation, catalog: Catalog, arrays: Arrays) -> None:
        self._place = place
        self._catalog = catalog
        self._arrays = arrays

    def make(self, name: str, *, tag: bool = False) -> BranchRow:
        """Make a branch by copying the catalog and settings, but no arrays; after an error, no partial branch remains.

        The branch is a separate map for exports and merging: it has its own id, its revisions name the map that solved
        them, and it has no export targets.

        Args:
            tag: make it read-only.

        Raises:
            ConfigError: the name is invalid or in use, or the path ``MAP@NAME`` exists.
            StoreError: the map's folder is not writable.
        """
        home = self._place.home
        if self._place.remote is not None:
            kind = "tag" if tag else "branch"
            raise ConfigError(
                f"{self._place.location} lies in a bucket, and maps in buckets have no branches or tags: copy "
                f"it with gsmap clone to a folder, and create the {kind} there",
                code="no_branches_in_bucket",
            )
        folder = home / FOLDER / validated_name(name)
        if folder.exists() or Path(f"{home}@{name}").exists():
            taken = "a branch or tag" if folder.exists() else f"the path {home}@{name}"
            raise ConfigError(
                f"{taken} with the name {name!r} exists already: choose another name", code="branch_exists"
            )
        if not os.access(home, os.W_OK):
            raise StoreError(
                f"{home} cannot be written, so no branch can be created in it: clone it to a folder that can be "
                "written",
                code="not_writable",
            )
        staged = folder.with_name(f".{name}.{uuid.uuid4().hex[:8]}")
        # The lock keeps arrays from being reclaimed between the copy and the rename.
        with translate_errors(home), displayed_as(staged, folder), self._arrays.lock():
            try:
                make_folder(staged.parent)
                staged.mkdir()
                self._copy_catalog(staged)
                if (self._place.folder / SETTINGS).is_file():
                    shutil.copyfile(self._place.folder / SETTINGS, staged / SETTINGS)
                    sync_file(staged / SETTINGS)
                marker = {"kind": "tag" if tag else "branch", "parent": self._place.branch, "created_at": now()}
                (staged / MARKER).write_text(json.dumps(marker))
                sync_file(staged / MARKER)
                # Leases, quarantined jobs and exports belong to the map, not to the branch.
                make_independent(staged, (leases, set_aside, tiles, exports), id=uuid.uuid4().hex)
                sync_folder(staged)
                os.rename(staged, folder)
                sync_folder(folder.parent)
            finally:
                shutil.rmtree(staged, ignore_errors=True)
        return self.get(name)

    def get(self, name: str) -> BranchRow:
        """Return a branch or tag by name.

        Raises:
            NotFoundError: no branch or tag has this name.
        """
        return _branch(self._named(name))

    def list(self) -> list[BranchRow]:
        """Return all branches and tags, by name."""
        return [_branch(place) for place in branch_locations(self._place.home)]

    def delete(self, name: str) -> None:
        """Delete a branch or tag; `prune` then reclaims the arrays that only this branch or tag named.

        Raises:
            NotFoundError: no branch or tag has this name.
            BusyError: another process is writing to it.
        """
        place = self._named(name)
        catalog = Catalog(place.folder, open_engine(place.folder, writable=False), writable=True)
        dead = place.folder.with_name(f".{name}.{uuid.uuid4().hex[:8]}")
        try:
            with translate_errors(place.home), catalog.lock(), self._arrays.lock():
                os.rename(place.folder, dead)
                sync_folder(dead.parent)
                shutil.rmtree(dead, ignore_errors=True)
        finally:
            catalog.engine.dispose()

    def _copy_catalog(self, folder: Path) -> None:
        """Copy the catalog to a ``map.sqlite`` in a folder, also from a server."""
        if self._catalog.is_sqlite:
            self._catalog.copy(folder / sqlite.FILE)
            return
        made = empty_catalog(folder)
        copy_catalog(self._catalog, made)
        made.close()

    def _named(self, name: str) -> MapLocation:
        for place in branch_locations(self._place.home):
            if place.branch == name:
                return place
        known = ", ".join(place.branch for place in branch_locations(self._place.home)) or "none"
        raise NotFoundError(
            f"{self._place.home} has no branch or tag {name!r}: it has {known}", code="branch_not_found"
        )


class OtherCatalogs:
    """All other catalogs for the arrays of a map; groups that they name must be kept.

    Args:
        home: root folder of the map.
        folder: folder of the catalog to leave out.
    """

    def __init__(self, home: Path, folder: Path) -> None:
        self._home = home
        self._folder = folder

    def verify(self) -> None:
        """Verify every page of the other catalogs, which is required before deleting arrays that none of them names.

        Raises:
            CorruptError: a catalog is damaged.
            StoreError: an entry of the branches folder is not a branch, and may have been one.
        """
        if strange := unknown_entries(self._home):
            raise StoreError(
                f"{self._home / strange[0]} is not a valid branch (it may have lost {MARKER} or its name), so "
                "nothing is reclaimed: restore what it lacks, or move it out of the map",
                code="stray_branch",
            )
        for place in other_locations(self._home, self._folder):
            with translate_errors(place.folder):
                catalog = Catalog(place.folder, open_engine(place.folder, writable=False), writable=False)
                try:
                    catalog.verify(whole=True)
                finally:
                    catalog.close(fold=False)

    def groups(self) -> set[tuple[str, str]]:
        """Return (kind, id) of all groups that the other catalogs name."""
        found: set[tuple[str, str]] = set()
        for connection in self._connections():
            found |= {(row.kind, row.id) for row in connection.execute(select(groups.c.kind, groups.c.id))}
        return found

    def models(self) -> set[str]:
        """Return the relative paths of the models that the other catalogs use."""
        current = select(models.c.path).where(models.c.removed_at.is_(None), models.c.copied == 1)
        return {path for connection in self._connections() for path in connection.execute(current).scalars()}

    def manifests(self, group_id: str) -> list[tuple[StoredFile, ...]]:
        """Return the manifest of a group from each other catalog that names the group."""
        query = select(files.c.path, files.c.size_bytes, files.c.sha256).where(files.c.group_id == group_id)
        found = [
            tuple(StoredFile(*row) for row in connection.execute(query.order_by(files.c.path)))
            for connection in self._connections()
        ]
        return [manifest for manifest in found if manifest]

    def _connections(self) -> Iterator[Connection]:
        for place in other_locations(self._home, self._folder):
            with _read(place) as connection:
                yield connection


def remove_leftovers(home: Path) -> None:
    """Delete leftovers of crashes while branches were made or deleted; the caller must hold the lock of the arrays."""
    root = home / FOLDER
    for folder in root.iterdir() if is_folder(root) else ():
        if _is_leftover(folder.name) and is_folder(folder):
            with contextlib.suppress(OSError):
                remove_tree(home, FOLDER, folder.name)


@contextlib.contextmanager
def _read(place: MapLocation) -> Iterator[Connection]:
    with translate_errors(place.folder):
        engine = open_engine(place.folder, writable=False)
        try:
            with engine.connect() as connection, connection.begin():
                yield connection
        finally:
            engine.dispose()


def _read_marker(folder: Path) -> dict[str, str]:
    try:
        marker = json.loads((folder / MARKER).read_text())
        return {
            "kind": "tag" if marker["kind"] == "tag" else "branch",
            **{k: str(marker[k]) for k in ("parent", "created_at")},
        }
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return {"kind": "tag", "parent": "", "created_at": ""}  # damaged: treat it as read-only


def _branch(place: MapLocation) -> BranchRow:
    marker = _read_marker(place.folder)
    revision, num_scenes = None, 0
    try:
        with _read(place) as connection:
            revision = connection.execute(select(func.max(revisions.c.number))).scalar()
            living = select(func.count()).select_from(scenes).where(scenes.c.removed_at.is_(None))
            num_scenes = connection.execute(living).scalar_one()
    except StoreError as error:  # the branch can still be listed and deleted
        _log.warning("%s", error)
    parent = replace(place, branch=marker["parent"]).location
    size = sum(path.stat().st_size for path in place.folder.iterdir() if path.is_file())
    from gsmap.types.rows.map_operations import BranchRow  # few maps have branches

    return BranchRow(
        name=place.branch,
        kind="tag" if place.is_tag else "branch",
        map=place.location,
        parent=parent,
        created_at=marker["created_at"],
        revision=revision,
        num_scenes=num_scenes,
        num_bytes=size,
    )

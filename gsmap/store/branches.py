"""Branches and tags: other catalogs over the same arrays. ``MAP@NAME`` opens one wherever a map is given.

A branch lies in ``MAP/branches/NAME`` with a catalog, settings and a writer lock of its own; arrays and models are the
map's, so that making one copies no array. A tag is a branch that is opened for reading only.
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

from sqlalchemy import Connection, func, select

from gsmap.durable import is_file, is_folder, make_folder, remove_tree, sync_file, sync_folder
from gsmap.errors import ConfigError, NotFoundError, StoreError
from gsmap.settings import FILE_NAME as SETTINGS
from gsmap.store import homes, sqlite, trust
from gsmap.store.arrays import Arrays, StoredFile
from gsmap.store.catalog import Catalog, now, open_engine
from gsmap.store.copying import copy_catalog, empty_catalog, make_own
from gsmap.store.explained import explained
from gsmap.store.homes import Home
from gsmap.store.schema import exports, files, groups, leases, models, revisions, scenes, set_aside, tiles

FOLDER = "branches"
MARKER = "branch.json"
_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,63}")  # it becomes a folder's name
_LEFTOVER = re.compile(rf"\.{_NAME.pattern}\.[0-9a-f]{{8}}")
_log = logging.getLogger("gsmap.store")


@dataclass(frozen=True)
class Place:
    """Where a map, or a branch of one, lies.

    Args:
        home: the map's folder: arrays, models.
        folder: where the catalog, ``settings.toml`` and the writer lock lie.
        branch: name of the branch or tag; empty for the map itself.
        is_tag: its catalog is not to be written.
        remote: the map's home where that is a bucket; the folders are its desk then.
    """

    home: Path
    folder: Path
    branch: str = ""
    is_tag: bool = False
    remote: Home | None = None

    @property
    def location(self) -> str:
        """The string that opens it again."""
        if self.remote is not None:
            return self.remote.url
        return f"{self.home}@{self.branch}" if self.branch else str(self.home)


@dataclass(frozen=True)
class Branch:
    """A branch or a tag.

    Args:
        name: unique among both in the map.
        is_tag: whether it cannot change.
        location: opens it.
        parent: location of what it was made of.
        created_at: when.
        revision: its newest revision; None before the first.
        num_scenes: its living scenes.
        num_bytes: of its folder; its arrays are the map's.
    """

    name: str
    is_tag: bool
    location: str
    parent: str
    created_at: str
    revision: int | None
    num_scenes: int
    num_bytes: int


def find(path: str | os.PathLike[str]) -> Place:
    """What a path means: the map there, or the branch of ``MAP@NAME``. A path that exists as it stands is a map.

    Raises:
        ConfigError: the map is there, and what follows ``@`` cannot be a branch's name.
        NotFoundError: the map has no such branch.
    """
    if homes.is_remote(path):
        remote = Home(os.fspath(path))
        return Place(remote.desk, remote.desk, remote=remote)
    folder = homes.local(path)
    left, at, name = str(folder).rpartition("@")
    if folder.exists() or not at or "/" in name or not is_map(Path(left)):
        return Place(folder, folder)
    home = Path(left)
    checked_name(name)
    for place in places(home):
        if place.branch == name:
            return place
    known = ", ".join(place.branch for place in places(home))
    there = f"it has {known}" if known else f"make it with gsmap branch {home} {name}"
    raise NotFoundError(f"{home} has no branch or tag {name!r}: {there}", code="branch_not_found")


def places(home: Path) -> list[Place]:
    """The branches and tags of a map, by name."""
    root = home / FOLDER
    found = []
    for folder in sorted(root.iterdir()) if is_folder(root) else ():
        ours = _NAME.fullmatch(folder.name) and is_folder(folder) and is_file(folder / sqlite.FILE)
        if ours and is_file(folder / MARKER):
            found.append(Place(home, folder, folder.name, _told(folder)["kind"] == "tag"))
    return found


def strangers(home: Path) -> list[str]:
    """Paths below the map of what lies among its branches and is none, nor what a crash left of one.

    Any of it may be a branch that lost a file or its name, and only that may know of some arrays.
    """
    root = home / FOLDER
    if not os.path.lexists(root):
        return []
    if not is_folder(root):
        return [FOLDER]
    known = {place.branch for place in places(home)}
    return [f"{FOLDER}/{name}" for name in sorted(os.listdir(root)) if name not in known and not _is_leftover(name)]


def _is_leftover(name: str) -> bool:
    """Whether a folder among the branches is one that is being made, or deleted, or that a crash left of that."""
    return _LEFTOVER.fullmatch(name) is not None


def other_places(home: Path, folder: Path) -> list[Place]:
    """Where the catalogs over a map's arrays lie, but the one in ``folder``: the map, its branches, its tags."""
    return [place for place in (Place(home, home), *places(home)) if place.folder != folder]


def checked_name(name: str) -> str:
    """A name that a branch can have.

    Raises:
        ConfigError: otherwise.
    """
    if not _NAME.fullmatch(name):
        raise ConfigError(
            "a branch or tag is called by up to 64 letters, digits, '.', '_' and '-', not beginning with '.': "
            f"{name!r}",
            code="invalid_name",
        )
    return name


def is_map(folder: Path) -> bool:
    """Whether a folder is a map."""
    return holds_catalog(folder) and (folder / "arrays").is_dir()


def holds_catalog(folder: Path) -> bool:
    """Whether a folder is that of a map or of a branch."""
    return (folder / sqlite.FILE).is_file() or (folder / trust.URL_FILE).is_file()


class Branches:
    """The branches and tags of a map, whichever of them is open.

    Args:
        place: what is open; a branch is made of it.
    """

    def __init__(self, place: Place, catalog: Catalog, arrays: Arrays) -> None:
        self._place = place
        self._catalog = catalog
        self._arrays = arrays

    def make(self, name: str, *, tag: bool = False) -> Branch:
        """Copy the catalog and settings; no array is copied. It appears whole or not at all.

        The branch is a map of its own for exports and for merging: it has another id, its revisions say which map
        solved them, and it knows none of the folders that were exported to.

        Args:
            tag: it can never change.

        Raises:
            ConfigError: the name cannot be or is taken, or a path of that kind exists.
            StoreError: the map's folder cannot be written.
        """
        home = self._place.home
        if self._place.remote is not None:
            kind = "tag" if tag else "branch"
            raise ConfigError(
                f"{self._place.location} lies in a bucket, where a map has no branches or tags: gsmap clone makes "
                f"a map of its own in a folder, which can have a {kind}",
                code="no_branches_in_bucket",
            )
        folder = home / FOLDER / checked_name(name)
        if folder.exists() or Path(f"{home}@{name}").exists():
            taken = "a branch or tag" if folder.exists() else f"the path {home}@{name}"
            raise ConfigError(f"{taken} of the name {name!r} exists already: choose another name", code="branch_exists")
        if not os.access(home, os.W_OK):
            raise StoreError(
                f"{home} cannot be written, so it can get no branch: copy it to where it can be", code="not_writable"
            )
        staged = folder.with_name(f".{name}.{uuid.uuid4().hex[:8]}")
        # Nobody reclaims arrays between the copy and the moment at which it counts.
        with explained(home), self._arrays.lock():
            try:
                make_folder(staged.parent)
                staged.mkdir()
                self._copy_catalog(staged)
                if (self._place.folder / SETTINGS).is_file():
                    shutil.copyfile(self._place.folder / SETTINGS, staged / SETTINGS)
                    sync_file(staged / SETTINGS)
                told = {"kind": "tag" if tag else "branch", "parent": self._place.branch, "created_at": now()}
                (staged / MARKER).write_text(json.dumps(told))
                sync_file(staged / MARKER)
                # Who is at work on it and where it was exported to is of the map.
                make_own(staged, (leases, set_aside, tiles, exports), id=uuid.uuid4().hex)
                sync_folder(staged)
                os.rename(staged, folder)
                sync_folder(folder.parent)
            finally:
                shutil.rmtree(staged, ignore_errors=True)
        return self.get(name)

    def get(self, name: str) -> Branch:
        """One branch or tag.

        Raises:
            NotFoundError: none is called so.
        """
        return _branch(self._named(name))

    def list(self) -> list[Branch]:
        """All branches and tags, by name."""
        return [_branch(place) for place in places(self._place.home)]

    def delete(self, name: str) -> None:
        """Forget a branch or tag; what only it named is reclaimed by `prune`.

        Raises:
            NotFoundError: none is called so.
            BusyError: another process is writing to it.
        """
        place = self._named(name)
        catalog = Catalog(place.folder, open_engine(place.folder, writable=False), writable=True)
        dead = place.folder.with_name(f".{name}.{uuid.uuid4().hex[:8]}")
        try:
            with explained(place.home), catalog.lock(), self._arrays.lock():
                os.rename(place.folder, dead)
                sync_folder(dead.parent)
                shutil.rmtree(dead, ignore_errors=True)
        finally:
            catalog.engine.dispose()

    def _copy_catalog(self, folder: Path) -> None:
        """The catalog as a ``map.sqlite`` in a folder; also where that of the map is on a server."""
        if self._catalog.is_sqlite:
            sqlite.backup(self._catalog.engine, folder / sqlite.FILE)
            return
        made = empty_catalog(folder)
        copy_catalog(self._catalog, made)
        made.close()

    def _named(self, name: str) -> Place:
        for place in places(self._place.home):
            if place.branch == name:
                return place
        known = ", ".join(place.branch for place in places(self._place.home)) or "none"
        raise NotFoundError(
            f"{self._place.home} has no branch or tag {name!r}: it has {known}", code="branch_not_found"
        )


class Others:
    """The other catalogs over the arrays of a map: what they name stays.

    Args:
        home: the map.
        folder: of the catalog that asks.
    """

    def __init__(self, home: Path, folder: Path) -> None:
        self._home = home
        self._folder = folder

    def verify(self) -> None:
        """Compare every page of them with what was written: before arrays are deleted that none of them names.

        Raises:
            CorruptError: one is damaged.
            StoreError: something lies among the branches that is none, and may have been one.
        """
        if strange := strangers(self._home):
            raise StoreError(
                f"{self._home / strange[0]} is no branch, and may be one that lost {MARKER} or its name: nothing is "
                "reclaimed while it lies there; put back what it lacks, or move it out of the map",
                code="stray_branch",
            )
        for place in other_places(self._home, self._folder):
            with explained(place.folder):
                catalog = Catalog(place.folder, open_engine(place.folder, writable=False), writable=False)
                try:
                    catalog.verify(whole=True)
                finally:
                    catalog.close(fold=False)

    def groups(self) -> set[tuple[str, str]]:
        """(kind, id) of all groups that they name."""
        found: set[tuple[str, str]] = set()
        for connection in self._connections():
            found |= {(row.kind, row.id) for row in connection.execute(select(groups.c.kind, groups.c.id))}
        return found

    def models(self) -> set[str]:
        """Paths below the map of the models that they use."""
        standing = select(models.c.path).where(models.c.removed_at.is_(None), models.c.copied == 1)
        return {path for connection in self._connections() for path in connection.execute(standing).scalars()}

    def manifests(self, group_id: str) -> list[tuple[StoredFile, ...]]:
        """The files of a group, as each of those knows them that name it."""
        query = select(files.c.path, files.c.size_bytes, files.c.sha256).where(files.c.group_id == group_id)
        found = [
            tuple(StoredFile(*row) for row in connection.execute(query.order_by(files.c.path)))
            for connection in self._connections()
        ]
        return [manifest for manifest in found if manifest]

    def _connections(self) -> Iterator[Connection]:
        for place in other_places(self._home, self._folder):
            with _read(place) as connection:
                yield connection


def bury_leftovers(home: Path) -> None:
    """Delete what a crash left of making or deleting branches; only under the lock of the arrays."""
    root = home / FOLDER
    for folder in root.iterdir() if is_folder(root) else ():
        if _is_leftover(folder.name) and is_folder(folder):
            with contextlib.suppress(OSError):
                remove_tree(home, FOLDER, folder.name)


@contextlib.contextmanager
def _read(place: Place) -> Iterator[Connection]:
    with explained(place.folder):
        engine = open_engine(place.folder, writable=False)
        try:
            with engine.connect() as connection, connection.begin():
                yield connection
        finally:
            engine.dispose()


def _told(folder: Path) -> dict[str, str]:
    try:
        told = json.loads((folder / MARKER).read_text())
        return {
            "kind": "tag" if told["kind"] == "tag" else "branch",
            **{k: str(told[k]) for k in ("parent", "created_at")},
        }
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return {"kind": "tag", "parent": "", "created_at": ""}  # damaged: it is better not written to


def _branch(place: Place) -> Branch:
    told = _told(place.folder)
    revision, num_scenes = None, 0
    try:
        with _read(place) as connection:
            revision = connection.execute(select(func.max(revisions.c.number))).scalar()
            living = select(func.count()).select_from(scenes).where(scenes.c.removed_at.is_(None))
            num_scenes = connection.execute(living).scalar_one()
    except StoreError as error:  # it can be listed and deleted all the same
        _log.warning("%s", error)
    parent = replace(place, branch=told["parent"]).location
    size = sum(path.stat().st_size for path in place.folder.iterdir() if path.is_file())
    return Branch(place.branch, place.is_tag, place.location, parent, told["created_at"], revision, num_scenes, size)

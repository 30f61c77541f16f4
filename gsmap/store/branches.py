"""Branches and tags: other catalogs over the same arrays. ``MAP@NAME`` opens one wherever a map is given.

A branch lies in ``MAP/branches/NAME`` with a catalog, settings and a writer lock of its own; arrays and models are the
map's, so that making one copies no array. A tag is a branch that is opened for reading only.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

from gsmap.errors import ConfigError, NotFoundError
from gsmap.store import sqlite
from gsmap.store.catalog import URL_FILE

FOLDER = "branches"
MARKER = "branch.json"
_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,63}")  # it becomes a folder's name


@dataclass(frozen=True)
class Place:
    """Where a map, or a branch of one, lies.

    Args:
        home: the map's folder: arrays, models.
        folder: where the catalog, ``settings.toml`` and the writer lock lie.
        branch: name of the branch or tag; empty for the map itself.
    """

    home: Path
    folder: Path
    branch: str = ""

    @property
    def location(self) -> str:
        """The string that opens it again."""
        return f"{self.home}@{self.branch}" if self.branch else str(self.home)


def find(path: str | os.PathLike[str]) -> Place:
    """What a path means: the map there, or the branch of ``MAP@NAME``. A path that exists as it stands is a map.

    Raises:
        ConfigError: the map is there, and what follows ``@`` cannot be a branch's name.
        NotFoundError: the map has no such branch.
    """
    folder = Path(path)
    left, at, name = str(folder).rpartition("@")
    if folder.exists() or not at or "/" in name or not is_map(Path(left)):
        return Place(folder, folder)
    home = Path(left)
    branch = home / FOLDER / checked_name(name)
    if not (branch / MARKER).is_file():
        known = names(home)
        there = f"there are {', '.join(known)}" if known else f"it has none; make one with gsmap branch {home} {name}"
        raise NotFoundError(f"{home} has no branch or tag {name!r}: {there}")
    return Place(home, branch, name)


def names(home: Path) -> list[str]:
    """The branches and tags of a map."""
    return sorted(
        marker.parent.name for marker in (home / FOLDER).glob(f"*/{MARKER}") if _NAME.fullmatch(marker.parent.name)
    )


def checked_name(name: str) -> str:
    """A name that a branch can have.

    Raises:
        ConfigError: otherwise.
    """
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f"a branch or tag is called by up to 64 letters, digits, '.', '_' and '-', not beginning with '.': {name!r}"
        )
    return name


def is_map(folder: Path) -> bool:
    """Whether a folder is a map."""
    return holds_catalog(folder) and (folder / "arrays").is_dir()


def holds_catalog(folder: Path) -> bool:
    """Whether a folder is that of a map or of a branch."""
    return (folder / sqlite.FILE).is_file() or (folder / URL_FILE).is_file()

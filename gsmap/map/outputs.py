"""Files and folders outside of a map that show its scenes, recorded so that a purge finds them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from gsmap.errors import DiskFullError, ReadOnlyError
from gsmap.store import Store


@dataclass(frozen=True)
class Output:
    """A kind of file or folder that a feature writes. Its functions take a path and the id of the map.

    Args:
        is_at: returns true if an output of this kind is at the path.
        num_files: returns the number of files to delete in a purge of a scene (id); 0 if the map does not own them.
        forget: deletes these files.
    """

    is_at: Callable[[Path, str], bool]
    num_files: Callable[[Path, str, str], int]
    forget: Callable[[Path, str, str], object]


class SceneCache(Protocol):
    """A folder in the user's cache folder with files of scenes."""

    root: Path

    def num_files(self, scene: str) -> int:
        """Return the number of files of a scene (id)."""

    def forget(self, scene: str) -> None:
        """Delete the files of a scene (id)."""


def note_target(store: Store, path: Path, settings: Mapping[str, Any]) -> str | None:
    """Record a folder or file that shows scenes, so that a purge finds it; return the reason for a failure, or None."""
    if str(path.resolve()) in {one.target for one in store.exports.list()}:
        return None
    if not store.catalog.writable:
        return f"{store.location} is read-only"
    try:
        store.exports.begin(path, revision=None, settings=settings)
    except (DiskFullError, ReadOnlyError) as error:
        return str(error)
    return None

"""Reading a file that SQLite has open in the same process.

POSIX locks belong to the process: closing *any* handle on a file drops every lock that SQLite holds on it. Another
process that closes the database then takes itself for the last one and deletes the log, with the commits that this one
still writes there. So a handle of ours on a catalog is opened once and closed after the last connection of the process.
"""

from __future__ import annotations

import os
import threading
from pathlib import Path

from gsmap.store.wal import Noted, index_note

_LOCK = threading.RLock()  # a collected connection may close its handle at any moment
_OPEN: dict[tuple[int, int], list[int]] = {}  # by device and inode: the handle, and how many use it


class Handle:
    """A handle for reading, shared by all users of a file in this process.

    Args:
        file: it must exist.

    Raises:
        OSError: what the system says.
    """

    def __init__(self, file: Path) -> None:
        with _LOCK:
            found = os.stat(file)
            if (found.st_dev, found.st_ino) not in _OPEN:
                number = os.open(file, os.O_RDONLY | os.O_CLOEXEC)
                found = os.fstat(number)  # it may have been replaced in between
                _OPEN.setdefault((found.st_dev, found.st_ino), [number, 0])
            self._key = found.st_dev, found.st_ino
            entry = _OPEN[self._key]
            entry[1] += 1
            self.number = entry[0]
            self.index: Noted | None = index_note(file) if entry[1] == 1 else None
            """What the index of its log said before anybody in this process connected; None where somebody has."""
        self._closed = False

    def is_of(self, file: Path) -> bool:
        """Whether the file at a path is still the one that was opened."""
        found = os.stat(file)
        return (found.st_dev, found.st_ino) == self._key

    def close(self) -> None:
        """Done; only after the connections of whoever opened it. Twice is once."""
        with _LOCK:
            if self._closed:
                return
            self._closed = True
            entry = _OPEN[self._key]
            entry[1] -= 1
            if not entry[1]:
                del _OPEN[self._key]
                os.close(entry[0])

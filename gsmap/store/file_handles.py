"""Shared read handles of database files that SQLite has open in this process.

POSIX locks belong to the process: closing *any* handle on a file drops every lock that SQLite holds on it. Another
process that closes the database then assumes that it is the last one and deletes the log, with commits that this
process is still writing. So a handle on a catalog is opened once and closed after the last connection of the process.
"""

from __future__ import annotations

import os
import threading
from pathlib import Path

from gsmap.store.wal import IndexHeader, read_index_header

_LOCK = threading.RLock()  # reentrant: the garbage collector may close a handle at any time
_OPEN: dict[tuple[int, int], list[int]] = {}  # handle and number of users by (device, inode)


class FileHandle:
    """A read handle, shared by all users of a file in this process.

    Args:
        file: an existing file.

    Raises:
        OSError: the file cannot be opened.
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
            self.index: IndexHeader | None = read_index_header(file) if entry[1] == 1 else None
            """Header of the log's index before this process connected to it; None if it was connected already."""
        self._closed = False

    def is_of(self, file: Path) -> bool:
        """Return True if the path still names the opened file."""
        found = os.stat(file)
        return (found.st_dev, found.st_ino) == self._key

    def close(self) -> None:
        """Close the handle, after the connections of its user; may be called twice."""
        with _LOCK:
            if self._closed:
                return
            self._closed = True
            entry = _OPEN[self._key]
            entry[1] -= 1
            if not entry[1]:
                del _OPEN[self._key]
                os.close(entry[0])

"""Reading the file of a database that SQLite has open in this process.

Closing any descriptor of a file drops all locks that the process has on it (POSIX), those of SQLite's connections
included. Another process would then take itself for the last one at the database and delete the log that this one goes
on writing to: what is committed after that is lost. So the descriptor to read by is opened once, and never closed.
"""

from __future__ import annotations

import hashlib
import os
import threading
from pathlib import Path

_CHUNK_BYTES = 1 << 20

_held: dict[tuple[int, int], int] = {}
_lock = threading.Lock()


def read(file: Path, offset: int, num_bytes: int) -> bytes:
    """Bytes of the file, fewer at its end.

    Raises:
        OSError: what the system says.
    """
    return os.pread(_descriptor(file), num_bytes, offset)


def sha256(file: Path) -> str:
    """The digest of all of the file."""
    digest, offset = hashlib.sha256(), 0
    while chunk := read(file, offset, _CHUNK_BYTES):
        digest.update(chunk)
        offset += len(chunk)
    return digest.hexdigest()


def _descriptor(file: Path) -> int:
    with _lock:
        about = os.stat(file)
        key = (about.st_dev, about.st_ino)
        if key not in _held:
            handle = os.open(file, os.O_RDONLY | os.O_CLOEXEC)
            opened = os.fstat(handle)
            key = (opened.st_dev, opened.st_ino)
            _held.setdefault(key, handle)  # where it is held already this one stays open, too: to close it is the harm
        return _held[key]

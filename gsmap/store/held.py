"""Reading the file of a database that SQLite has open in this process.

Closing any descriptor of a file drops all locks that the process has on it (POSIX), those of SQLite's connections
included. Another process would then take itself for the last one at the database and delete the log that this one goes
on writing to: what is committed after that is lost. So as long as a connection is open, the descriptor to read by is
not closed; the connections are counted (`enter`, `leave`).
"""

from __future__ import annotations

import hashlib
import os
import threading
from dataclasses import dataclass, field
from pathlib import Path

Key = tuple[int, int]
_CHUNK_BYTES = 1 << 20


@dataclass
class _File:
    connections: int = 0
    descriptors: list[int] = field(default_factory=list)


_files: dict[Key, _File] = {}
_lock = threading.RLock()


def enter(file: Path) -> Key:
    """Say that SQLite is about to open a file; to be taken back with `leave` when it has closed it.

    Raises:
        OSError: there is no such file.
    """
    with _lock:
        about = os.stat(file)
        key = (about.st_dev, about.st_ino)
        _files.setdefault(key, _File()).connections += 1
        return key


def leave(key: Key) -> None:
    """A connection is closed; with the last one goes the descriptor."""
    with _lock:
        held = _files[key]
        held.connections -= 1
        if held.connections == 0:
            for descriptor in _files.pop(key).descriptors:
                os.close(descriptor)


def read(file: Path, offset: int, num_bytes: int) -> bytes:
    """Bytes of the file, fewer at its end.

    Raises:
        OSError: what the system says.
    """
    with _lock:
        key = enter(file)
        try:
            held = _files[key]
            if not held.descriptors:
                held.descriptors.append(os.open(file, os.O_RDONLY | os.O_CLOEXEC))
            return os.pread(held.descriptors[0], num_bytes, offset)
        finally:
            leave(key)


def sha256(file: Path) -> str:
    """The digest of all of the file."""
    digest, offset = hashlib.sha256(), 0
    while chunk := read(file, offset, _CHUNK_BYTES):
        digest.update(chunk)
        offset += len(chunk)
    return digest.hexdigest()

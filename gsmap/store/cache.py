"""A local cache of files of immutable groups that were read from an object store.

Files are named by their digest and verified against it when they are stored, so that maps share common files. The least
recently used ones are evicted first. All of it may be deleted at any time.
"""

from __future__ import annotations

import contextlib
import functools
import glob
import hashlib
import logging
import os
import uuid
from collections.abc import Iterable
from pathlib import Path

from gsmap.errors import ConfigError, CorruptError

_log = logging.getLogger("gsmap.store")

FOLDER_VARIABLE = "GSMAP_CACHE"
SIZE_VARIABLE = "GSMAP_CACHE_MB"
_DEFAULT_MB = 10_000


def folder() -> Path:
    """Return the cache folder: the environment variable ``GSMAP_CACHE``, or ``gsmap`` in the user's cache folder."""
    named = os.environ.get(FOLDER_VARIABLE)
    base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(named).expanduser() if named else Path(base).expanduser() / "gsmap"


def max_bytes() -> int:
    """Return the maximum size of the cache in bytes, from the environment variable ``GSMAP_CACHE_MB``."""
    named = os.environ.get(SIZE_VARIABLE) or str(_DEFAULT_MB)
    if not named.isdecimal():
        raise ConfigError(
            f"the environment variable {SIZE_VARIABLE} must be a number of megabytes, got {named!r}",
            code="invalid_environment",
        )
    return int(named) * 1_000_000


def find(sha256: str) -> Path | None:
    """Return the cached file with this digest; None if it is not cached."""
    path = folder() / "files" / sha256
    with contextlib.suppress(OSError):
        os.utime(path)
        return path if path.is_file() else None
    return None


def keep(sha256: str, chunks: Iterable[bytes], what: str) -> Path:
    """Store a file in the cache.

    Args:
        what: name of the file for messages.

    Raises:
        CorruptError: the bytes do not match the digest; nothing is stored.
        OSError: the cache cannot be written.
    """
    root = folder() / "files"
    root.mkdir(mode=0o700, parents=True, exist_ok=True)
    staged, digest = root / f".{uuid.uuid4().hex}", hashlib.sha256()
    try:
        with open(staged, "xb") as file:
            for chunk in chunks:
                digest.update(chunk)
                file.write(chunk)
        if digest.hexdigest() != sha256:
            raise CorruptError(f"{what} differs from what gsmap wrote", code="bytes_differ")
        make_room(root)
        os.replace(staged, root / sha256)
    finally:
        staged.unlink(missing_ok=True)
    return root / sha256


def drop(sha256: str) -> None:
    """Delete cached files by digest or digest prefix."""
    for path in (folder() / "files").glob(f"{glob.escape(sha256)}*"):
        path.unlink(missing_ok=True)


def report_failure(error: OSError) -> None:
    """Log an error of the cache, once for each folder and error."""
    _warn(folder(), error.strerror or str(error))


@functools.cache
def _warn(root: Path, reason: str) -> None:
    _log.warning(
        "the cache %s cannot be used (%s), so that files are downloaded at each read: free some space, or set %s to "
        "another folder",
        root,
        reason,
        FOLDER_VARIABLE,
    )


def make_room(root: Path) -> None:
    """Delete the least recently used files of a folder until it, with the staged file, is within the limit."""
    kept = []
    for entry in os.scandir(root):
        with contextlib.suppress(FileNotFoundError):
            about = entry.stat(follow_symlinks=False)
            kept.append((about.st_mtime, about.st_size, entry.name))
    over = sum(size for _, size, _ in kept) - max_bytes()
    for _, size, name in sorted(kept):
        if over <= 0:
            break
        if not name.startswith("."):
            (root / name).unlink(missing_ok=True)
            over -= size

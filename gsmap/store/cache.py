"""Files of immutable groups that were read from an object store, kept on this machine for a while.

They are named by their digest and compared with it when they come, so that two maps share what they have in common. The
ones that were used longest ago go first. Anything here may be deleted at any time.
"""

from __future__ import annotations

import contextlib
import glob
import hashlib
import os
import uuid
from collections.abc import Iterable
from pathlib import Path

from gsmap.errors import ConfigError, CorruptError

FOLDER_VARIABLE = "GSMAP_CACHE"
SIZE_VARIABLE = "GSMAP_CACHE_MB"
_DEFAULT_MB = 10_000


def folder() -> Path:
    """Where everything is kept: ``GSMAP_CACHE``, else in the user's folder of caches."""
    named = os.environ.get(FOLDER_VARIABLE)
    base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(named).expanduser() if named else Path(base).expanduser() / "gsmap"


def max_bytes() -> int:
    """How much is kept at most: ``GSMAP_CACHE_MB``."""
    named = os.environ.get(SIZE_VARIABLE) or str(_DEFAULT_MB)
    if not named.isdecimal():
        raise ConfigError(f"{SIZE_VARIABLE} must be a number of megabytes, got {named!r}", code="invalid_environment")
    return int(named) * 1_000_000


def find(sha256: str) -> Path | None:
    """The file of a digest, if it is kept."""
    path = folder() / "files" / sha256
    with contextlib.suppress(OSError):
        os.utime(path)
        return path
    return None


def keep(sha256: str, chunks: Iterable[bytes], what: str) -> Path:
    """Keep a file.

    Args:
        what: it is, for messages.

    Raises:
        CorruptError: its bytes are not those of the digest; nothing is kept.
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
            raise CorruptError(f"{what} differs from what was written", code="bytes_differ")
        _make_room(root, staged.stat().st_size)
        os.replace(staged, root / sha256)
    finally:
        staged.unlink(missing_ok=True)
    return root / sha256


def drop(sha256: str) -> None:
    """Forget a file, by its digest or the beginning of it."""
    for path in (folder() / "files").glob(f"{glob.escape(sha256)}*"):
        path.unlink(missing_ok=True)


def _make_room(root: Path, size_bytes: int) -> None:
    """Delete what was used longest ago until so many bytes more are within bounds."""
    kept = []
    for entry in os.scandir(root):
        with contextlib.suppress(FileNotFoundError):
            about = entry.stat(follow_symlinks=False)
            kept.append((about.st_mtime, about.st_size, entry.name))
    over = sum(size for _, size, _ in kept) - max_bytes()  # what is coming is among them
    for _, size, name in sorted(kept):
        if over <= 0:
            break
        if not name.startswith("."):
            (root / name).unlink(missing_ok=True)
            over -= size

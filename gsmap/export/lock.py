"""An exclusive lock of an export folder, which the kernel releases when the process ends."""

from __future__ import annotations

import errno
import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path

from gsmap import platform
from gsmap.durable import make_folder, sync_folder
from gsmap.errors import BusyError, StoreError
from gsmap.types.lock_owner import LockOwner, this_process

LOCK_FILE = ".gsmap-export"
"""Name of the lock file, which describes the lock owner; after a crash, an unlocked file may remain."""

_POLL_S = 0.5
_NOT_OURS_TO_WRITE = (errno.EACCES, errno.EPERM, errno.EROFS)


@contextmanager
def folder_lock(out: Path, *, wait: bool = False, waiting: Callable[[str], None] | None = None) -> Iterator[None]:
    """Lock a folder for one export; create a missing folder, and remove it if it is still empty at the end.

    A read-only folder is not locked: there is nothing to do in it, or writing raises an error.

    Args:
        out: the folder; a path that is no folder is not locked.
        wait: wait until another export has ended, instead of raising an error.
        waiting: called once with the description of the lock owner.

    Raises:
        BusyError: another export holds the lock; the message names its process.
        StoreError: the folder cannot be made, or the disk is full.
    """
    if out.exists() and not out.is_dir():
        yield
        return
    try:
        handle, fresh = _acquire(out, wait, waiting)
    except OSError as error:
        raise StoreError(f"cannot write the export to {out}: {error.strerror or error}", code="not_writable") from error
    try:
        yield
    finally:
        if handle is not None:
            with suppress(OSError):
                (out / LOCK_FILE).unlink()
                sync_folder(out)
            os.close(handle)
        if fresh:
            with suppress(OSError):
                out.rmdir()


def _acquire(out: Path, wait: bool, waiting: Callable[[str], None] | None) -> tuple[int | None, bool]:
    """Return the open lock file (None in a read-only folder), and true if the folder was created."""
    path, reported, fresh = out / LOCK_FILE, False, False
    while True:
        if not out.is_dir():
            make_folder(out)
            fresh = True
        try:
            handle = _open(path)
        except FileNotFoundError:
            continue  # the process that made the folder has removed it
        if handle is None:
            return None, fresh
        try:
            platform.lock(handle, wait=False)
        except BlockingIOError:
            owner = _owner_of(handle)
            os.close(handle)
            if not wait:
                raise BusyError(
                    f"{out}: {owner} is exporting to it; retry later, or pass --wait",
                    code="export_busy",
                ) from None
            if waiting is not None and not reported:
                waiting(f"waiting for {owner}")
            reported = True
            time.sleep(_POLL_S)
            continue
        if _is_at(handle, path):
            with suppress(OSError):  # opened for reading, or a full disk: the owner stays unknown
                os.ftruncate(handle, 0)
                os.write(handle, json.dumps(asdict(this_process("export"))).encode())
            return handle, fresh
        os.close(handle)  # its last owner has removed it between the two calls


def _open(path: Path) -> int | None:
    # A link is not followed, as its target would be overwritten.
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
    except OSError as error:
        if error.errno not in _NOT_OURS_TO_WRITE:
            raise
    try:
        return os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)  # of another user
    except OSError:
        return None


def _is_at(handle: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), os.stat(path))
    except FileNotFoundError:
        return False


def _owner_of(handle: int) -> str:
    try:
        stored = json.loads(os.pread(handle, 10_000, 0))
        return LockOwner(**{name: str(stored[name]) for name in ("task", "host", "process", "since")}).who
    except (OSError, ValueError, KeyError, TypeError):
        return "another gsmap export"

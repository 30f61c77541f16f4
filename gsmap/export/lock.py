"""One export to a folder at a time, from whatever map: the lock lies in the folder, and the kernel frees it."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path

from gsmap.durable import make_folder, sync_folder
from gsmap.errors import BusyError, StoreError
from gsmap.types.holder import Holder, this_process

LOCK_FILE = ".gsmap-export"
"""There while an export is at work, and holds who that is; one that a crash left is nobody's."""

_POLL_S = 0.5
_NOT_OURS_TO_WRITE = (errno.EACCES, errno.EPERM, errno.EROFS)


@contextmanager
def folder_lock(out: Path, *, wait: bool = False, waiting: Callable[[str], None] | None = None) -> Iterator[None]:
    """Hold a folder for one export; it is made if missing, and goes again if it is still empty at the end.

    A folder that cannot be written is not locked: there is nothing to do in it, or writing will say so.

    Args:
        out: the folder. Of what is no folder nothing is said here.
        wait: until another export has ended, instead of refusing.
        waiting: told once who it is waited for.

    Raises:
        BusyError: another export is at work in it; the message names its process.
        StoreError: the folder cannot be made, or the disk is full.
    """
    if out.exists() and not out.is_dir():
        yield
        return
    try:
        handle, fresh = _locked(out, wait, waiting)
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


def _locked(out: Path, wait: bool, waiting: Callable[[str], None] | None) -> tuple[int | None, bool]:
    """The open lock file, None where there can be none; and whether the folder was made for it."""
    path, told, fresh = out / LOCK_FILE, False, False
    while True:
        if not out.is_dir():
            make_folder(out)
            fresh = True
        try:
            handle = _opened(path)
        except FileNotFoundError:
            continue  # who made the folder took it away again
        if handle is None:
            return None, fresh
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            who = _holder(handle)
            os.close(handle)
            if not wait:
                raise BusyError(
                    f"{out}: {who} is exporting to it; wait until it has ended, or let this wait for it with --wait",
                    code="export_busy",
                ) from None
            if waiting is not None and not told:
                waiting(f"waiting for {who}")
            told = True
            time.sleep(_POLL_S)
            continue
        if _is_at(handle, path):
            with suppress(OSError):  # opened for reading, or a full disk: who it is stays untold
                os.ftruncate(handle, 0)
                os.write(handle, json.dumps(asdict(this_process("export"))).encode())
            return handle, fresh
        os.close(handle)  # its last holder took it away between the two calls


def _opened(path: Path) -> int | None:
    # A link is not followed: what it leads to is no lock of ours, and would be written to.
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
    except OSError as error:
        if error.errno not in _NOT_OURS_TO_WRITE:
            raise
    try:
        return os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)  # another user's
    except OSError:
        return None


def _is_at(handle: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), os.stat(path))
    except FileNotFoundError:
        return False


def _holder(handle: int) -> str:
    try:
        told = json.loads(os.pread(handle, 10_000, 0))
        return Holder(**{name: str(told[name]) for name in ("task", "host", "process", "since")}).who
    except (OSError, ValueError, KeyError, TypeError):
        return "another gsmap export"

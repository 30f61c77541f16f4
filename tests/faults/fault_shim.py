"""The other side of ``shim.c``: building it, arming it, and reading what it wrote down."""

from __future__ import annotations

import ctypes
import errno
import hashlib
import os
import shutil
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

SOURCE = Path(__file__).with_name("shim.c")
_HEAD = struct.Struct("=5Q")

NAMES = {"w": "write", "f": "fsync", "t": "truncate", "u": "unlink", "d": "rmdir", "m": "mkdir", "r": "rename"}
NAMES |= {"c": "create", "l": "link", "s": "symlink", "#": "mark", "!": "fired", "?": "nothing"}


@dataclass(frozen=True)
class Mode:
    """What happens at the Nth change.

    Args:
        name: how tables call it.
        number: as ``shim.c`` numbers it.
        code: the errno of what is refused.
        kinds: letters of the changes that it can meet; another is passed on.
    """

    name: str
    number: int
    code: int = 0
    kinds: str = "wftudmrcls"

    @property
    def kills(self) -> bool:
        return self.number in (1, 2)


_SPACE = "wcmlsr"
PASS = Mode("pass", 0)
MODES = {
    mode.name: mode
    for mode in (
        Mode("kill-before", 1),
        Mode("kill-after", 2),
        Mode("eio-once", 3, errno.EIO),
        Mode("eio-ever", 4, errno.EIO),
        Mode("enospc-once", 3, errno.ENOSPC, _SPACE),
        Mode("enospc-ever", 4, errno.ENOSPC, _SPACE),
        Mode("short-once", 5, 0, "w"),
    )
}
KILLS = tuple(name for name, mode in MODES.items() if mode.kills)
FAULTS = tuple(name for name, mode in MODES.items() if not mode.kills)


@dataclass(frozen=True)
class Change:
    """One change of the disk: a letter of `NAMES`, a path, the new path of a rename, and what was written where."""

    kind: str
    path: str
    other: str
    offset: int
    data: bytes

    def __str__(self) -> str:
        return f"{NAMES[self.kind]} {self.path}{f' -> {self.other}' if self.other else ''}"


def why_not() -> str | None:
    """Why this machine cannot run the shim; None where it can."""
    if sys.platform != "linux" or not hasattr(os, "fork"):
        return "the shim is for Linux"
    if os.confstr("CS_GNU_LIBC_VERSION") is None:
        return "the shim is for the GNU C library"
    if shutil.which("cc") is None:
        return "the shim needs a C compiler"
    return None


def built() -> Path:
    """The compiled shim; made where this user has none of this source."""
    digest = hashlib.sha256(SOURCE.read_bytes()).hexdigest()[:16]
    target = Path(tempfile.gettempdir()) / f"gsmap-shim-{os.getuid()}-{digest}.so"
    if target.is_file() and target.stat().st_uid == os.getuid():
        return target
    staged = Path(tempfile.mkdtemp()) / target.name
    flags = ["-O2", "-shared", "-fPIC", "-Wall", "-Wextra", "-Werror"]
    subprocess.run(["cc", *flags, "-o", staged, SOURCE, "-ldl", "-pthread"], check=True, capture_output=True, text=True)
    os.replace(staged, target)
    staged.parent.rmdir()
    return target


class Shim:
    """The shim in this process, which was started with it in ``LD_PRELOAD``."""

    def __init__(self) -> None:
        self._library = ctypes.CDLL(None)
        self._library.shim_arm.argtypes = [
            *(ctypes.c_char_p, ctypes.c_long, ctypes.c_int, ctypes.c_int, ctypes.c_int, ctypes.c_int)
        ]
        self._library.shim_count.restype = ctypes.c_long
        self._library.shim_mark.argtypes = [ctypes.c_char_p]

    def arm(self, folder: Path, n: int, mode: Mode, log: Path, *, data: bool = False) -> None:
        """From now on count what this process changes below ``folder``, and act at the ``n``-th.

        Args:
            log: where the changes are written down; it lies elsewhere.
            data: also write down the bytes.
        """
        handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
        self._library.shim_arm(os.fsencode(folder.resolve()), n, mode.number, mode.code, handle, int(data))

    def disarm(self) -> None:
        self._library.shim_disarm()

    def mark(self, text: str) -> None:
        """Write a remark between the changes."""
        self._library.shim_mark(text.encode())

    @property
    def count(self) -> int:
        """Changes since it was armed."""
        return int(self._library.shim_count())


def changes(log: Path) -> Iterator[Change]:
    """What the shim wrote down, in order."""
    content = log.read_bytes() if log.exists() else b""
    at = 0
    while at + _HEAD.size <= len(content):
        kind, *lengths = _HEAD.unpack_from(content, at)
        path, other, offset, data = lengths
        at += _HEAD.size
        parts = []
        for length in (path, other, data):
            parts.append(content[at : at + length])
            at += length
        yield Change(chr(kind), os.fsdecode(parts[0]), os.fsdecode(parts[1]), offset, parts[2])

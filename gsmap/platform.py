"""Calls that differ between operating systems: locks, processors, shared memory, limits and identity of processes.

No other module imports `fcntl` or `resource`, calls the scheduler or reads ``/proc``. Linux has the functions marked
"Linux"; elsewhere, and everywhere if the environment variable GSMAP_PLATFORM is ``portable`` (which the tests set),
POSIX alone is used, as on macOS. Processes that start as scripts import this module, so it imports nothing of gsmap.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import resource
import socket
import sys
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path

IS_LINUX = sys.platform.startswith("linux") and os.environ.get("GSMAP_PLATFORM") != "portable"

_PR_SET_PDEATHSIG = 1  # <linux/prctl.h>
_ESTABLISHED = "01"  # state of a TCP connection in /proc/net/tcp


def lock(handle: int, *, shared: bool = False, wait: bool = True) -> None:
    """Lock an open file or folder; the lock ends when the descriptor is closed, also by the end of the process.

    Raises:
        BlockingIOError: another process holds the lock, and ``wait`` is false.
    """
    fcntl.flock(handle, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | (0 if wait else fcntl.LOCK_NB))


def num_processors() -> int:
    """Return the number of processors that this process may use (Linux), or of all of the machine."""
    return len(os.sched_getaffinity(0)) if IS_LINUX else os.cpu_count() or 1


@contextlib.contextmanager
def pinned_thread() -> Iterator[None]:
    """Pin the calling thread, and threads that are started from it, to one processor (Linux); otherwise do nothing."""
    if not IS_LINUX:
        yield
        return
    free = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(free)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, free)


def shared_memory(name: str) -> int:
    """Open an unnamed file, in memory on Linux.

    Args:
        name: shown by tools that list open files.
    """
    if IS_LINUX:
        return os.memfd_create(name)
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


def descriptor_folders() -> set[str]:
    """Return the real paths of the folders whose entries are the open files of this process."""
    return {os.path.realpath(folder) for folder in (("/proc/self/fd",) if IS_LINUX else ()) + ("/dev/fd",)}


# --- processes --------------------------------------------------------------------------------------------------------


def end_with_thread_of_parent() -> None:
    """Let the kernel kill this process when the thread that started it ends (Linux); otherwise do nothing."""
    if IS_LINUX:
        import ctypes
        import signal

        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def end_with_input() -> None:
    """Let the kernel end this process when the other end of its standard input closes (Linux); otherwise do nothing."""
    if IS_LINUX:
        fcntl.fcntl(0, fcntl.F_SETOWN, os.getpid())
        fcntl.fcntl(0, fcntl.F_SETFL, fcntl.fcntl(0, fcntl.F_GETFL) | os.O_ASYNC)


def limit_process(memory_bytes: int) -> None:
    """Forbid this process core dumps and writing files; limit its memory beyond its libraries (Linux)."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    if IS_LINUX:
        with contextlib.suppress(OSError, ValueError):
            mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (mapped + memory_bytes, mapped + memory_bytes))


def prefer_to_be_killed() -> None:
    """Let the system end this process first if the machine runs out of memory (Linux); otherwise do nothing."""
    if IS_LINUX:
        with contextlib.suppress(OSError):
            Path("/proc/self/oom_score_adj").write_text("1000")


@cache
def machine_id() -> str:
    """Return an identifier of what two processes must share to compare their ids: kernel and pid namespace (Linux), or
    the host name.

    Containers of one machine may share its name, and a machine its name with another; neither shares both of these.
    """
    if IS_LINUX:
        with contextlib.suppress(OSError):
            boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
            return f"{boot}/{os.readlink('/proc/self/ns/pid')}"
    return socket.gethostname()


def process_start(process: int | None = None) -> str | None:
    """Return the start time of a process in ticks since boot; ``ended`` for a zombie; None if unknown.

    Args:
        process: its id; default: this process.
    """
    if not IS_LINUX:
        return None
    try:
        path = Path(f"/proc/{'self' if process is None else process}/stat")
        fields = path.read_text().rpartition(")")[2].split()
        return "ended" if fields[0] in "ZX" else fields[19]
    except (OSError, IndexError):
        return None


def user_of_connection(client: tuple[str, int], server: tuple[str, int]) -> int | None:
    """Return the user whose process is the client of a local IPv4 connection (Linux); None if unknown."""
    if not IS_LINUX:
        return None
    here, there = _hexadecimal(*client), _hexadecimal(*server)
    for name, prefix in (("tcp", ""), ("tcp6", "0000000000000000FFFF0000")):  # IPv4 connections of IPv6 sockets
        try:
            rows = Path("/proc/net", name).read_text(encoding="ascii").splitlines()[1:]
        except OSError:
            continue
        for row in rows:
            _, local, remote, state, _, _, _, user, *_ = row.split()
            if (local, remote, state) == (prefix + here, prefix + there, _ESTABLISHED):
                return int(user)
    return None


def _hexadecimal(host: str, port: int) -> str:
    """Format an IPv4 address as in /proc/net: in the byte order of the machine."""
    return f"{int.from_bytes(socket.inet_aton(host), sys.byteorder):08X}:{port:04X}"

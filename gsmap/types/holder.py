"""Who is at work: which process of which machine, at what, since when; and whether it still is."""

from __future__ import annotations

import os
import socket
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from pathlib import Path


@dataclass(frozen=True)
class Holder:
    """A process at work.

    Args:
        task: the verb.
        host: name of its machine.
        process: its number there, then what tells it from others of that number: when it started and which machine
            (kernel and container) it runs on, as `this_process` gives them.
        since: when it began, ISO 8601, UTC.
    """

    task: str
    host: str
    process: str
    since: str

    @property
    def pid(self) -> int:
        """Number of the process on its machine; 0 where what was written makes no sense."""
        first = self.process.partition(" ")[0]
        return int(first) if first.isdecimal() and len(first) < 10 else 0

    @property
    def who(self) -> str:
        """In words, such as ``gsmap update (process 123 on HOST, since 14:02)``; of another day, the date too."""
        try:
            since = datetime.fromisoformat(self.since).astimezone()
            text = f"{since:%H:%M}" if since.date() == datetime.now().astimezone().date() else f"{since:%Y-%m-%d %H:%M}"
        except (ValueError, OverflowError):
            text = self.since
        words = f"gsmap {self.task} (process {self.pid} on {self.host}, since {text})"
        return "".join(c if c.isprintable() else "?" for c in words)  # it was read from a file that others may write

    @property
    def is_gone(self) -> bool:
        """Whether it has ended: known of processes of this machine only; False where nobody can tell."""
        number, _, rest = self.process.partition(" ")
        started, _, machine = rest.partition(" ")
        if not self.pid or machine != _machine():
            return False
        try:
            os.kill(self.pid, 0)
        except ProcessLookupError:
            return True
        except OSError:
            pass  # another user's
        now = _started(number)
        return now is not None and now != started


def this_process(task: str) -> Holder:
    """This process, at a task from now on."""
    process = f"{os.getpid()} {_started('self') or '-'} {_machine()}"
    return Holder(task, socket.gethostname(), process, datetime.now(UTC).isoformat(timespec="microseconds"))


@cache
def _machine() -> str:
    """What processes must share for one to judge the other by its number: a running kernel, and a space of numbers.

    Containers of one machine may share its name, and a machine its name with another; neither shares both of these.
    """
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{boot}/{os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return socket.gethostname()


def _started(number: str) -> str | None:
    """When a process started, in ticks since its machine did; ``ended`` of one that nobody has buried yet. None where
    that cannot be read."""
    try:
        fields = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()
        return "ended" if fields[0] in "ZX" else fields[19]
    except (OSError, IndexError):
        return None

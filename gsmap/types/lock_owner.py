"""The process that owns a lock or lease, its task, and a test whether the process still runs."""

from __future__ import annotations

import os
import socket
from dataclasses import dataclass
from datetime import UTC, datetime

from gsmap import platform


@dataclass(frozen=True)
class LockOwner:
    """A process that holds a lock or lease.

    Args:
        task: the verb.
        host: name of its machine.
        process: process id, start time and machine (kernel and container), as `this_process` gives them; the id alone
            may be reused.
        since: start of the task, ISO 8601, UTC.
    """

    task: str
    host: str
    process: str
    since: str

    @property
    def pid(self) -> int:
        """Process id on its machine; 0 if the stored text is invalid."""
        first = self.process.partition(" ")[0]
        return int(first) if first.isdecimal() and len(first) < 10 else 0

    @property
    def who(self) -> str:
        """Description such as ``gsmap update (process 123 on HOST, since 14:02)``, with the date if the task began
        before today.
        """
        try:
            since = datetime.fromisoformat(self.since).astimezone()
            text = f"{since:%H:%M}" if since.date() == datetime.now().astimezone().date() else f"{since:%Y-%m-%d %H:%M}"
        except (ValueError, OverflowError):
            text = self.since
        words = f"gsmap {self.task} (process {self.pid} on {self.host}, since {text})"
        return "".join(c if c.isprintable() else "?" for c in words)  # it was read from a file that others may write

    @property
    def is_gone(self) -> bool:
        """True if the process certainly has ended; always false for a process of another machine."""
        _, _, rest = self.process.partition(" ")
        started, _, machine = rest.partition(" ")
        if not self.pid or machine != platform.machine_id():
            return False
        try:
            os.kill(self.pid, 0)
        except ProcessLookupError:
            return True
        except OSError:
            pass  # another user's
        now = platform.process_start(self.pid)
        return now is not None and now != started


def this_process(task: str) -> LockOwner:
    """Return this process as the owner of a task that starts now."""
    process = f"{os.getpid()} {platform.process_start() or '-'} {platform.machine_id()}"
    return LockOwner(task, socket.gethostname(), process, datetime.now(UTC).isoformat(timespec="microseconds"))

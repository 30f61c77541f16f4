"""Running processes of a map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from gsmap.types.rows.base import Row


@dataclass(frozen=True, eq=False, kw_only=True)
class LeaseRow(Row):
    """The task of a running process.

    Args:
        what: ``map`` (shared with other processes), ``poses``, ``graph KEY`` or ``edge KEY`` (one job), or ``export
            FOLDER``.
        task: the verb.
        host: name of the process's machine.
        process: process id.
        since: start of this work, ISO 8601, UTC.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "task": "verb",
        "host": "host",
        "process": "process",
        "since": "since",
        "what": "at work on",
    }

    what: str
    task: str
    host: str
    process: int
    since: str

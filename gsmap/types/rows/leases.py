"""Who is at work on a map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from gsmap.types.rows.base import Row


@dataclass(frozen=True, eq=False, kw_only=True)
class AtWorkRow(Row):
    """Something that a process is at work on.

    Args:
        what: ``map`` (as a whole, together with others), ``poses``, ``graph KEY`` or ``edge KEY`` (one job), or
            ``export FOLDER``.
        task: the verb.
        host: name of the process's machine.
        process: its number there.
        since: when it began this, ISO 8601, UTC.
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

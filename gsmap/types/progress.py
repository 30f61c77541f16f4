"""Callbacks that report progress."""

from __future__ import annotations

from collections.abc import Callable
from contextvars import ContextVar

Progress = Callable[[float, str], None]
"""A callback that gets the finished fraction in [0, 1] and a text that names the current work."""

StageProgress = Callable[[str, float, str], None]
"""A callback that gets the name of the stage, the finished fraction in [0, 1], and a text that names the current
work.
"""


JobProgress = Callable[[int, float, str], None]
"""Called with the index of a job among those of a run, the fraction of it that is done, and its step."""


def silent(fraction: float, text: str) -> None:
    """Discard reports of progress."""


def _ignore(index: int, fraction: float, text: str) -> None:
    """Ignore the progress of a job."""


job_progress: ContextVar[Progress] = ContextVar("progress of the job that runs in this process", default=silent)
jobs_progress: ContextVar[JobProgress] = ContextVar("progress of the jobs of a run in other processes", default=_ignore)

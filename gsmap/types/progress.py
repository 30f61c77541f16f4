"""Callbacks that report progress."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[float, str], None]
"""A callback that gets the finished fraction in [0, 1] and a text that names the current work."""

StageProgress = Callable[[str, float, str], None]
"""A callback that gets the name of the stage, the finished fraction in [0, 1], and a text that names the current
work.
"""


def silent(fraction: float, text: str) -> None:
    """Discard reports of progress."""

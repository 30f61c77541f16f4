"""Callbacks that report progress."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[float, str], None]
"""Called with the fraction done in [0, 1] and what is being worked on."""

StageProgress = Callable[[str, float, str], None]
"""Called with the stage's name, the fraction done in [0, 1], and what is being worked on."""


def silent(fraction: float, text: str) -> None:
    """Ignore progress."""

"""Limits on the size and time of reading scans."""

from __future__ import annotations

from dataclasses import dataclass

from gsmap.settings.ranges import require_range

MAX_POINTS = 2_000_000
"""Largest number of points that are read from a cloud (evenly spaced if it has more), and of samples of a mesh."""


@dataclass(frozen=True)
class Params:
    """Limits of the process that reads a mesh or a LAS file.

    Args:
        max_seconds: Longest wall time in seconds, positive, before the process that reads a scan is ended with an
            error; larger values admit larger files.
        max_memory_mb: Memory in MiB, positive, that the process that reads a scan may take; larger values admit
            larger files.
    """

    max_seconds: float = 120.0
    max_memory_mb: int = 8192

    def __post_init__(self) -> None:
        require_range(self, "(0, inf]", *vars(self))

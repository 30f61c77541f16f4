"""How scans are read."""

from __future__ import annotations

from dataclasses import dataclass, fields

from gsmap.errors import ConfigError


@dataclass(frozen=True)
class Params:
    """How scans are read.

    Args:
        max_points: of a cloud of more points an even share is taken; a mesh is sampled at most this often.
        min_depth: pixels of a depth picture nearer than this, in metres, show nothing ...
        max_depth: ... nor do those farther than this: depth sensors see noise there.
        edge: nor those where the depth jumps by more than this share of it from a pixel to the next: sensors put points
            between the two surfaces.
        time_s: wall seconds after which the process that reads a mesh is ended.
        memory_mb: memory that it may take.
    """

    max_points: int = 2_000_000
    min_depth: float = 0.1
    max_depth: float = 10.0
    edge: float = 0.04
    time_s: float = 120.0
    memory_mb: int = 8192

    def __post_init__(self) -> None:
        for field in fields(self):
            if not getattr(self, field.name) > 0:
                raise ConfigError(f"{field.name} of reading scans must be positive, got {getattr(self, field.name)}")

"""What a file of Gaussians says about itself."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class FileInfo:
    """What a file says about itself beside its Gaussians.

    Args:
        antialiased: trained with the 2D Mip filter.
        notes: what a person should know about how it was read.
    """

    antialiased: bool = False
    notes: tuple[str, ...] = ()

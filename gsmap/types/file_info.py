"""Metadata of a file of Gaussians."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class FileInfo:
    """Metadata that a file stores beside its Gaussians.

    Args:
        antialiased: trained with the 2D Mip filter.
        notes: remarks about how it was read.
    """

    antialiased: bool = False
    notes: tuple[str, ...] = ()

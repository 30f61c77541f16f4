"""Gaussians that need not be in memory."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import numpy as np

from gsmap.types.gaussians import Gaussians


class GaussianSource(Protocol):
    """N Gaussians in one frame that are read a chunk at a time, as often as asked, and every time the same.

    `Gaussians` are one themselves. Who reads a source needs memory for a chunk (`gsmap.types.gaussians.CHUNK_ROWS`),
    not for the scene; who needs all of it at once says ``load``. All chunks are about one origin, and so are the means
    among the columns (`origin_of_source`).
    """

    @property
    def num_gaussians(self) -> int:
        """N."""
        ...

    @property
    def sh_degree(self) -> int:
        """Of the spherical harmonics, 0 to 3."""
        ...

    def chunks(self) -> Iterator[Gaussians]:
        """All of them in order, at most ``CHUNK_ROWS`` at a time.

        Raises:
            InputError, CorruptError: what they are read from is not what it was.
        """
        ...

    def columns(self, name: str) -> Iterator[np.ndarray]:
        """As `chunks`, of one field of `Gaussians` alone, which may cost less."""
        ...

    def load(self) -> Gaussians:
        """All of them in memory."""
        ...


def origin_of_source(source: GaussianSource) -> np.ndarray:
    """(3,) float64 origin that the means of a source are about."""
    first = next(iter(source.chunks()), None)
    return np.zeros(3) if first is None else first.origin


def gathered(source: GaussianSource, name: str, rows: np.ndarray) -> np.ndarray:
    """The given rows (M,), in ascending order, of one field of a source."""
    out, start = [], 0
    for column in source.columns(name):
        first, last = np.searchsorted(rows, (start, start + len(column)))
        if first < last:
            out.append(column[rows[first:last] - start])
        else:
            out.append(column[:0])
        start += len(column)
    found: np.ndarray = np.concatenate(out)
    return found

"""Gaussians that are read in chunks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gsmap.types.gaussians import Gaussians


class GaussianSource(Protocol):
    """A set of N Gaussians in one frame that can be read in chunks, any number of times.

    `Gaussians` are one themselves. Who reads a source needs memory for a chunk (`gsmap.types.gaussians.CHUNK_ROWS`),
    not for the scene; who needs all of it at once says ``load``. All chunks are about one origin, and so are the means
    among the columns (`origin_of_source`).
    """

    @property
    def num_gaussians(self) -> int:
        """Number of Gaussians."""
        ...

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        ...

    def chunks(self) -> Iterator[Gaussians]:
        """Yield all Gaussians in order, at most ``CHUNK_ROWS`` at a time.

        Raises:
            InputError, CorruptError: what they are read from is not what it was.
        """
        ...

    def columns(self, name: str) -> Iterator[np.ndarray]:
        """Yield one field of `Gaussians` in chunks, which may be faster than `chunks`."""
        ...

    def load(self) -> Gaussians:
        """Return all Gaussians in memory."""
        ...


def origin_of_source(source: GaussianSource) -> np.ndarray:
    """Return the origin (3,) float64 that a source's means are relative to."""
    first = next(iter(source.chunks()), None)
    return np.zeros(3) if first is None else first.origin


def gathered(source: GaussianSource, name: str, rows: np.ndarray) -> np.ndarray:
    """Return one field of a source at the given rows (M,), which must ascend."""
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


@dataclass(frozen=True, eq=False)
class ChunkSource:
    """Stored chunks of the N Gaussians of a scene.

    Args:
        num_gaussians: N.
        sh_degree: degree of the spherical harmonics.
        boxes: (C, 2, 3) boxes around the chunks in stored order, extended by three standard deviations along each axis.
        rows: number of Gaussians of a chunk; the last chunk may have fewer.
        read: ``read(fields, start, stop, out)`` reads fields of rows ``[start, stop)`` into Gaussians of that
            number.
    """

    num_gaussians: int
    sh_degree: int
    boxes: np.ndarray
    rows: int
    read: Callable[[Sequence[str], int, int, Gaussians], None]

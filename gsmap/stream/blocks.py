"""Read a Gaussian source completely, in blocks of another size, or relative to another origin."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from gsmap.geometry.boxes import box_around
from gsmap.types import Gaussians, GaussianSource
from gsmap.types.gaussians import FIELDS
from gsmap.types.source import origin_of_source


def load_all(source: GaussianSource) -> Gaussians:
    """Load all Gaussians of a source; the additional memory is at most one chunk."""
    n, k = source.num_gaussians, (source.sh_degree + 1) ** 2
    shapes = {"means": (n, 3), "quats": (n, 4), "log_scales": (n, 3), "logit_opacities": (n,), "sh": (n, k, 3)}
    out = {name: np.empty(shapes[name], np.float32) for name in FIELDS}
    origin = np.zeros(3)
    start = 0
    for chunk in source.chunks():
        origin = chunk.origin
        for name in FIELDS:
            out[name][start : start + len(chunk)] = getattr(chunk, name)
        start += len(chunk)
    return Gaussians(**out, origin=origin)


def blocks(source: GaussianSource, rows: int) -> Iterator[Gaussians]:
    """Yield all Gaussians of a source in order, in blocks of ``rows``; the last block may be smaller."""
    held: list[Gaussians] = []
    count = 0
    for chunk in source.chunks():
        held.append(chunk)
        count += len(chunk)
        if count < rows:
            continue
        joined = held[0] if len(held) == 1 else Gaussians.concatenate(held)
        whole = count - count % rows
        for start in range(0, whole, rows):
            yield joined[start : start + rows]
        held, count = [joined[whole:]], count - whole
    if count:
        yield Gaussians.concatenate(held)


def shift_origin(source: GaussianSource, origin: np.ndarray) -> GaussianSource:
    """Return a source of the same Gaussians with means relative to another origin (3,)."""
    return source.about(origin) if isinstance(source, Gaussians) else _ShiftedSource(source, origin)


@dataclass(frozen=True, eq=False)
class _ShiftedSource:
    source: GaussianSource
    origin: np.ndarray

    @property
    def num_gaussians(self) -> int:
        return self.source.num_gaussians

    @property
    def sh_degree(self) -> int:
        return self.source.sh_degree

    def chunks(self) -> Iterator[Gaussians]:
        for chunk in self.source.chunks():
            yield chunk.about(self.origin)

    def columns(self, name: str) -> Iterator[np.ndarray]:
        if name != "means":
            yield from self.source.columns(name)
            return
        shift = origin_of_source(self.source) - self.origin
        for means in self.source.columns(name):
            yield (means + shift).astype(np.float32)

    def load(self) -> Gaussians:
        return self.source.load().about(self.origin)


def bounds(source: GaussianSource) -> np.ndarray:
    """Compute the (2, 3) float32 bounds of the means of a non-empty source."""
    corners = [box_around(means) for means in source.columns("means") if len(means)]
    return box_around(np.concatenate(corners))

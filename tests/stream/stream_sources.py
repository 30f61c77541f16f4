"""A source of Gaussians that counts how it is read, in chunks of any size."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from gsmap.types import Gaussians


@dataclass
class Pieces:
    """Gaussians handed out in pieces of ``rows``; ``reads`` counts how often they were read whole."""

    gaussians: Gaussians
    rows: int
    reads: list[str] = field(default_factory=list)

    @property
    def num_gaussians(self) -> int:
        return len(self.gaussians)

    @property
    def sh_degree(self) -> int:
        return self.gaussians.sh_degree

    def chunks(self) -> Iterator[Gaussians]:
        self.reads.append("all")
        for start in range(0, len(self.gaussians), self.rows):
            yield self.gaussians[start : start + self.rows]

    def columns(self, name: str) -> Iterator[np.ndarray]:
        self.reads.append(name)
        for start in range(0, len(self.gaussians), self.rows):
            yield getattr(self.gaussians, name)[start : start + self.rows]

    def load(self) -> Gaussians:
        self.reads.append("load")
        return self.gaussians


def scattered(count: int, seed: int = 0, sh_degree: int = 1) -> Gaussians:
    """Gaussians at random places, each different from all others in every field."""
    rng = np.random.default_rng(seed)
    k = (sh_degree + 1) ** 2
    return Gaussians(
        rng.normal(size=(count, 3)) * [4, 2, 1],
        rng.normal(size=(count, 4)),
        rng.normal(-4, 0.5, size=(count, 3)),
        rng.normal(size=count),
        rng.normal(size=(count, k, 3)),
    )


def same(a: Gaussians, b: Gaussians) -> bool:
    """Whether two sets are the same, bit for bit and row for row."""
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in vars(a))

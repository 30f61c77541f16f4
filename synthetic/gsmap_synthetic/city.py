"""A city as large as wanted, made chunk by chunk: blocks of houses along streets, never in memory as a whole.

For measuring what grows with the number of Gaussians (`tools/bench/city.py`); nothing in it is trained.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from gsmap.geometry.sh import sh0_of_rgb
from gsmap.types import Gaussians

PER_BLOCK = 50_000
BLOCK_M = 20.0
_STREET_M = 4.0


@dataclass(frozen=True)
class City:
    """A `gsmap.types.GaussianSource`: square blocks of one house each, in rows.

    Args:
        num_blocks: each has `PER_BLOCK` Gaussians and is `BLOCK_M` long and wide.
        seed: of the houses.
        sh_degree: of the colours, which do not depend on the direction.
    """

    num_blocks: int
    seed: int = 0
    sh_degree: int = 0

    @property
    def num_gaussians(self) -> int:
        return self.num_blocks * PER_BLOCK

    @property
    def side(self) -> int:
        """Blocks in a row."""
        return int(np.ceil(np.sqrt(self.num_blocks)))

    def chunks(self) -> Iterator[Gaussians]:
        for block in range(self.num_blocks):
            yield self.block(block)

    def columns(self, name: str) -> Iterator[np.ndarray]:
        for chunk in self.chunks():
            yield getattr(chunk, name)

    def load(self) -> Gaussians:
        return Gaussians.concatenate(list(self.chunks()))

    def block(self, index: int) -> Gaussians:
        """The house of a block and the street around it; z is up, streets lie at 0."""
        rng = np.random.default_rng((self.seed, index))
        row, column = divmod(index, self.side)
        size = np.array([*rng.uniform(0.5, 0.9, 2) * (BLOCK_M - _STREET_M), rng.uniform(4, 20)])
        walls = 2 * (size[0] + size[1]) * size[2]
        areas = np.array([walls, size[0] * size[1], BLOCK_M**2])  # walls, roof, street
        counts = rng.multinomial(PER_BLOCK, areas / areas.sum())
        points = np.concatenate([_walls(size, counts[0], rng), _roof(size, counts[1], rng), _street(counts[2], rng)])
        points += [BLOCK_M * (column + 0.5), BLOCK_M * (row + 0.5), 0.0]
        tones = np.repeat(rng.uniform(0.1, 0.9, (3, 3)), counts, axis=0)
        spacing = np.sqrt(areas.sum() / PER_BLOCK)
        sh = np.zeros((PER_BLOCK, (self.sh_degree + 1) ** 2, 3))
        sh[:, 0] = sh0_of_rgb(np.clip(tones + rng.normal(0, 0.05, tones.shape), 0, 1))
        return Gaussians(
            points,
            rng.normal(size=(PER_BLOCK, 4)),
            np.log(spacing) + rng.normal(-0.7, 0.3, (PER_BLOCK, 3)),
            rng.normal(2.0, 1.0, PER_BLOCK),
            sh,
        )


def _walls(size: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 3) points on the four walls of a house in the middle of its block."""
    along = rng.uniform(0, 2 * (size[0] + size[1]), count)
    corners = np.cumsum([size[0], size[1], size[0]])
    side = np.searchsorted(corners, along, side="right")
    t = along - np.concatenate([[0.0], corners])[side]
    x = np.choose(side, [t, np.full(count, size[0]), size[0] - t, np.zeros(count)])
    y = np.choose(side, [np.zeros(count), t, np.full(count, size[1]), size[1] - t])
    return np.stack([x - size[0] / 2, y - size[1] / 2, rng.uniform(0, size[2], count)], 1)


def _roof(size: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    xy = rng.uniform(-0.5, 0.5, (count, 2)) * size[:2]
    return np.concatenate([xy, np.full((count, 1), size[2])], 1)


def _street(count: int, rng: np.random.Generator) -> np.ndarray:
    xy = rng.uniform(-0.5, 0.5, (count, 2)) * BLOCK_M
    return np.concatenate([xy, np.zeros((count, 1))], 1)

"""Small things that people put down and take away: built like furniture, a hand's breadth or two in size."""

from __future__ import annotations

import numpy as np

from gsmap_synthetic import textures as tx
from gsmap_synthetic.furniture import Piece, colour, palette
from gsmap_synthetic.surfaces import Surfaces


def vase(s: Surfaces, rng: np.random.Generator, w: float, d: float) -> None:
    r, h = w / 2, rng.uniform(0.22, 0.3)
    glaze = tx.fabric(
        colour(rng, saturation=(0.5, 0.9)), colour(rng), int(rng.integers(99)), int(rng.integers(4)), 0.06
    )
    s.lathe(0, d / 2, 0, [(r * 0.6, 0), (r, h * 0.4), (r * 0.45, h * 0.8), (r * 0.7, h)], glaze, 12)


def box(s: Surfaces, rng: np.random.Generator, w: float, d: float) -> None:
    side, lid = colour(rng, saturation=(0.4, 0.9)), colour(rng, saturation=(0.4, 0.9))
    h = rng.uniform(0.15, 0.24)
    s.box(0, d / 2, 0, w, d, h, tx.plain(side, int(rng.integers(99))))
    s.box(0, d / 2, h, w + 0.01, d + 0.01, 0.03, tx.plain(lid, int(rng.integers(99))))


def books(s: Surfaces, rng: np.random.Generator, w: float, d: float) -> None:
    z = 0.0
    for _ in range(int(rng.integers(5, 8))):
        thick, shrink = rng.uniform(0.025, 0.045), rng.uniform(0.85, 1.0)
        cover = tx.plain(colour(rng, saturation=(0.4, 0.95), value=(0.25, 0.9)), int(rng.integers(99)))
        top = tx.picture(palette(rng), int(rng.integers(1 << 20)), int(rng.integers(4)))
        s.box(0, d / 2, z, w * shrink, d * shrink, thick, cover, top=top)
        z += thick


SMALL = {
    "books": Piece(books, (0.26, 0.3), (0.19, 0.22), symmetry="half", small=True),
    "box": Piece(box, (0.2, 0.3), (0.16, 0.24), symmetry="half", small=True),
    "vase": Piece(vase, (0.15, 0.2), (0.15, 0.2), symmetry="any", small=True),
}

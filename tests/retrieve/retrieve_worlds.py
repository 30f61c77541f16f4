"""Graphs with known partners, for the tests of this room."""

from __future__ import annotations

import numpy as np

from gsmap.types import NodeLayer, SceneGraph

UP = np.array([0.0, 0.0, 1.0])


def layer(
    rng, n, *, embeddings=None, types=3, dim=16, type_ids=None, descriptor="test", positions=None, unit_m=1.0
) -> NodeLayer:
    positions = rng.uniform(0, 1, (n, 3)) * [8, 6, 2.5] if positions is None else positions
    embeddings = rng.normal(size=(n, dim)) if embeddings is None else embeddings
    embeddings = embeddings / np.linalg.norm(embeddings, axis=1, keepdims=True)
    type_ids = rng.integers(0, types, n) if type_ids is None else type_ids
    extents = np.stack([positions - 0.1, positions + 0.1], 1)
    seen = np.zeros(n, np.int32)
    return NodeLayer(positions, embeddings, type_ids, np.ones(n), extents, embeddings, seen, descriptor, unit_m)


def walk(num_scenes: int, seed: int = 0, noise: float = 0.15) -> list[SceneGraph]:
    """Scenes along a corridor, each in a frame of its own: each shares a third of its nodes with the next."""
    rng = np.random.default_rng(seed)
    count = num_scenes * 40 + 40
    features, kinds = rng.normal(size=(count, 24)), rng.integers(0, 3, count)
    places = np.stack([np.arange(count) / 10, rng.uniform(0, 3, count), rng.uniform(0, 2.5, count)], 1)
    graphs = []
    for i in range(num_scenes):
        seen = slice(i * 40, i * 40 + 60)
        e = features[seen] + rng.normal(size=(60, 24)) * noise
        p = turned(places[seen] + rng.normal(size=(60, 3)) * 0.01, rng)
        nodes = layer(rng, 60, embeddings=e, type_ids=kinds[seen], positions=p)
        graphs.append(SceneGraph(f"s{i:03}", {"landmarks": nodes}, UP))
    return graphs


def turned(positions: np.ndarray, rng) -> np.ndarray:
    """The same places in a frame that is turned about the vertical and moved."""
    angle = rng.uniform(0, 2 * np.pi)
    cos, sin = np.cos(angle), np.sin(angle)
    return positions @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]).T + rng.uniform(-9, 9, 3)

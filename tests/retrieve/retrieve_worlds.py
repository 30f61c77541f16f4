"""Graphs with known partners, for the tests of this room."""

from __future__ import annotations

import numpy as np

from gsmap.types import NodeLayer, SceneGraph


def layer(rng, n, *, embeddings=None, types=3, dim=16, type_ids=None, descriptor="test") -> NodeLayer:
    positions = rng.uniform(0, 1, (n, 3)) * [8, 6, 2.5]
    embeddings = rng.normal(size=(n, dim)) if embeddings is None else embeddings
    embeddings = embeddings / np.linalg.norm(embeddings, axis=1, keepdims=True)
    type_ids = rng.integers(0, types, n) if type_ids is None else type_ids
    extents = np.stack([positions - 0.1, positions + 0.1], 1)
    return NodeLayer(
        positions, embeddings, type_ids, np.ones(n), extents, embeddings, np.zeros(n, np.int32), descriptor
    )


def walk(num_scenes: int, seed: int = 0, noise: float = 0.15) -> list[SceneGraph]:
    """Scenes along a corridor: each shares a third of its nodes with the next."""
    rng = np.random.default_rng(seed)
    features, kinds = rng.normal(size=(num_scenes * 40 + 40, 24)), rng.integers(0, 3, num_scenes * 40 + 40)
    graphs = []
    for i in range(num_scenes):
        seen = slice(i * 40, i * 40 + 60)
        e = features[seen] + rng.normal(size=(60, 24)) * noise
        graphs.append(SceneGraph(f"s{i:03}", {"landmarks": layer(rng, 60, embeddings=e, type_ids=kinds[seen])}))
    return graphs

"""Worlds of nodes with known partners, for the tests of this room."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.geometry.rotations import exp_so3
from gsmap.register.correspondences import Correspondences
from gsmap.types import NodeLayer, SceneGraph, Sim3


@dataclass
class NodeWorld:
    target: NodeLayer
    source: NodeLayer
    partner: np.ndarray  # row of the source for each row of the target, -1 where it has none
    S_target_source: Sim3
    matches: Correspondences  # the true pairs and some wrong ones
    up_target: np.ndarray
    up_source: np.ndarray

    def graphs(self) -> tuple[SceneGraph, SceneGraph]:
        return (
            SceneGraph("target", {"landmarks": self.target}, self.up_target),
            SceneGraph("source", {"landmarks": self.source}, self.up_source),
        )


def layer(rng, n, *, positions=None, embeddings=None, types=3, dim=16, type_ids=None) -> NodeLayer:
    positions = rng.uniform(0, 1, (n, 3)) * [8, 6, 2.5] if positions is None else positions
    embeddings = rng.normal(size=(n, dim)) if embeddings is None else embeddings
    embeddings = embeddings / np.linalg.norm(embeddings, axis=1, keepdims=True)
    type_ids = rng.integers(0, types, n) if type_ids is None else type_ids
    extents = np.stack([positions - 0.1, positions + 0.1], 1)
    return NodeLayer(
        positions, embeddings, type_ids, np.ones(n), extents, embeddings, np.zeros(n, np.int32), method="test"
    )


def node_world(seed=0, shared=80, extra=80, noise_m=0.02, wrong=200, scale=1.0, embedding_noise=0.05) -> NodeWorld:
    """Two scenes that share ``shared`` nodes; the frames differ by a random rotation, translation and scale."""
    rng = np.random.default_rng(seed)
    S = Sim3(exp_so3(rng.normal(size=3) * 2), rng.normal(size=3) * 10, scale)
    inverse = S.inverse()
    room = np.array([8.0, 6.0, 2.5])
    common = rng.uniform(0, 1, (shared, 3)) * room
    features, types = rng.normal(size=(shared, 16)), rng.integers(0, 3, shared)

    def side(move):
        points = np.concatenate([common, rng.uniform(0, 1, (extra, 3)) * room])
        points = points + rng.normal(size=points.shape) * noise_m
        e = np.concatenate([features + rng.normal(size=features.shape) * embedding_noise, rng.normal(size=(extra, 16))])
        order = rng.permutation(shared + extra)
        kinds = np.concatenate([types, rng.integers(0, 3, extra)])
        return layer(rng, len(points), positions=move(points)[order], embeddings=e[order], type_ids=kinds[order]), order

    target, order_t = side(lambda x: x)
    source, order_s = side(inverse.apply)
    where = np.empty(shared + extra, int)
    where[order_s] = np.arange(shared + extra)
    partner = np.where(order_t < shared, where[order_t], -1)
    rows = np.flatnonzero(partner >= 0)
    t = np.concatenate([rows, rng.integers(0, len(target), wrong)]).astype(np.int32)
    s = np.concatenate([partner[rows], rng.integers(0, len(source), wrong)]).astype(np.int32)
    up = np.array([0.0, 0, 1])
    matches = Correspondences(
        target.positions[t],
        source.positions[s],
        t,
        s,
        np.ones(len(t), np.float32),
    )
    return NodeWorld(target, source, partner, S, matches, up, S.rotation.T @ up)

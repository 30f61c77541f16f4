"""Select and encode the nodes of a scene for an inverted index and for lookups in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.geometry.directions import level_frame
from gsmap.retrieve import codes
from gsmap.retrieve.codes import NUM_DIMS
from gsmap.types import NodeLayer, SceneGraph
from gsmap.types.retrieval import IndexedScene

INDEX_VERSION = 2
"""Version of the nodes in an index; an index of an older version is rebuilt."""

WIDTH = NUM_DIMS + 6 + 4
"""Bytes of a node in an index: its code, its position as three float16 numbers, and the place of its scene in the
index."""


@dataclass(frozen=True, eq=False)
class Nodes:
    """M nodes of a scene.

    Args:
        keys: (M,) int64 inverted list of each node, ascending.
        codes: (M, NUM_DIMS) int8 codes.
        positions: (M, 3) float16 positions in metres relative to their mean, levelled if gravity is known.
    """

    keys: np.ndarray
    codes: np.ndarray
    positions: np.ndarray

    def __len__(self) -> int:
        return len(self.keys)


@dataclass(frozen=True, eq=False)
class SceneNodes:
    """Nodes of a scene to be indexed, and nodes with which the scene queries the index.

    Args:
        index_nodes: nodes that queries find.
        query_nodes: nodes that search the index. Scenes with known gravity match each other by their upright landmarks;
            pairs with a scene of unknown gravity match by gravity-free landmarks.
    """

    member: IndexedScene
    index_nodes: Nodes
    query_nodes: Nodes


def select_nodes(graph: SceneGraph, key: str, nodes_per_scene: int) -> SceneNodes:
    """Select the strongest nodes of each layer of a scene graph that is stored under a key.

    Layers for estimated units are skipped if a layer of metric size (``landmarks``, ``landmarks@K``) has nodes. An
    empty layer counts as missing: all corners and patterns of a large, coarse capture may be larger than landmarks of
    metric size.
    """
    upright = graph.up is not None
    metric = {name.split("@")[0] for name, layer in graph.layers.items() if ":" not in name and len(layer)}
    level = np.eye(3) if graph.up is None else level_frame(graph.up)
    index_nodes: list[Nodes] = []
    query_nodes: list[Nodes] = []
    for name, layer in sorted(graph.layers.items()):
        if not len(layer) or (":" in name and name.split(":")[0] in metric):
            continue
        other_frame = name.startswith("landmarks_gravity_free")
        unit_m = 1.0 if "landmarks" in metric else layer.unit_m  # use the scene's own unit if that may be the metre
        nodes = _select_strongest(layer, nodes_per_scene, unit_m * level)
        index_nodes.append(_with_keys(nodes, layer.descriptor_id, second=other_frame))
        query_nodes.append(_with_keys(nodes, layer.descriptor_id, second=False))
        if not upright:
            query_nodes.append(_with_keys(nodes, layer.descriptor_id, second=True))
    coarseness = 1.0 / graph.working_m if "landmarks" in metric else 1.0
    member = IndexedScene(graph.scene_id, key, upright, "landmarks" in metric, coarseness)
    return SceneNodes(member, *_join_groups(index_nodes, query_nodes))


@dataclass(frozen=True, eq=False)
class _SelectedNodes:
    types: np.ndarray
    codes: np.ndarray
    positions: np.ndarray


def _select_strongest(layer: NodeLayer, count: int, to_metres: np.ndarray) -> _SelectedNodes:
    rows = np.argsort(-layer.weights, kind="stable")[:count]
    return _SelectedNodes(layer.types[rows], codes.encode(layer.embeddings[rows]), layer.positions[rows] @ to_metres.T)


def _with_keys(nodes: _SelectedNodes, descriptor_id: str, *, second: bool) -> Nodes:
    keys = codes.keys_of(codes.space(descriptor_id, second=second), nodes.types, nodes.codes)
    return Nodes(keys, nodes.codes, nodes.positions)


def _join_groups(*groups: list[Nodes]) -> list[Nodes]:
    """Join the parts of each group, sorted by key, with positions relative to the mean of the first group."""
    first = [nodes.positions for nodes in groups[0]]
    centre = np.concatenate(first).mean(0) if first else np.zeros(3)
    return [_join(group, centre) for group in groups]


def _join(parts: list[Nodes], centre: np.ndarray) -> Nodes:
    if not parts:
        return Nodes(np.zeros(0, np.int64), np.zeros((0, NUM_DIMS), np.int8), np.zeros((0, 3), np.float16))
    keys = np.concatenate([nodes.keys for nodes in parts])
    found = np.concatenate([nodes.codes for nodes in parts])
    positions = np.clip(np.concatenate([nodes.positions for nodes in parts]) - centre, -6e4, 6e4).astype(np.float16)
    order = np.argsort(keys, kind="stable")
    return Nodes(keys[order], found[order], positions[order])

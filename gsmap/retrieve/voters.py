"""The nodes of a scene that vote for other scenes, and are voted for, as an index keeps them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.geometry.directions import level_frame
from gsmap.retrieve import codes
from gsmap.retrieve.codes import NUM_DIMS
from gsmap.types import NodeLayer, SceneGraph
from gsmap.types.retrieval import Member

INDEX_VERSION = 2
"""Of what an index holds of a scene; another one is made anew."""

WIDTH = NUM_DIMS + 6 + 4
"""Bytes of a node in an index: its code, its position as three float16, its scene's place among those of the index."""


@dataclass(frozen=True, eq=False)
class Nodes:
    """M nodes of a scene.

    Args:
        keys: (M,) int64 the list that each lies in, or is looked for in; rising.
        codes: (M, NUM_DIMS) int8.
        positions: (M, 3) float16 metres about their mean, level where the scene is upright.
    """

    keys: np.ndarray
    codes: np.ndarray
    positions: np.ndarray

    def __len__(self) -> int:
        return len(self.keys)


@dataclass(frozen=True, eq=False)
class Voters:
    """A scene as it is kept in an index, and as it asks one.

    Args:
        kept: nodes that others find.
        asking: nodes that look for others'. Landmarks of scenes that know up are found by each other; scenes that do
            not know it, and those that do, find each other by what is the same in any frame.
    """

    member: Member
    kept: Nodes
    asking: Nodes


def voters_of(graph: SceneGraph, key: str, nodes_per_scene: int) -> Voters:
    """Select the strongest nodes of each layer of a graph that is kept under a key.

    The layers at guessed units are left out where the same landmarks have nodes at any size that takes the scene's unit
    for a metre (``landmarks``, ``landmarks@K``). An empty layer counts as absent: the corners and patterns of a large,
    coarse capture may all be larger than landmarks at the metre.
    """
    upright = graph.up is not None
    metric = {name.split("@")[0] for name, layer in graph.layers.items() if ":" not in name and len(layer)}
    level = np.eye(3) if graph.up is None else level_frame(graph.up)
    kept: list[Nodes] = []
    asking: list[Nodes] = []
    for name, layer in sorted(graph.layers.items()):
        if not len(layer) or (":" in name and name.split(":")[0] in metric):
            continue
        other_frame = name.startswith("landmarks_gravity_free")
        unit_m = 1.0 if "landmarks" in metric else layer.unit_m  # the scene's unit, where that may be the metre
        nodes = _strongest(layer, nodes_per_scene, unit_m * level)
        kept.append(_in_space(nodes, layer.descriptor_id, second=other_frame))
        asking.append(_in_space(nodes, layer.descriptor_id, second=False))
        if not upright:
            asking.append(_in_space(nodes, layer.descriptor_id, second=True))
    coarseness = 1.0 / graph.working_m if "landmarks" in metric else 1.0
    member = Member(graph.scene_id, key, upright, "landmarks" in metric, coarseness)
    return Voters(member, *_centred(kept, asking))


@dataclass(frozen=True, eq=False)
class _Strongest:
    types: np.ndarray
    codes: np.ndarray
    positions: np.ndarray


def _strongest(layer: NodeLayer, count: int, to_metres: np.ndarray) -> _Strongest:
    rows = np.argsort(-layer.weights, kind="stable")[:count]
    return _Strongest(layer.types[rows], codes.encode(layer.embeddings[rows]), layer.positions[rows] @ to_metres.T)


def _in_space(nodes: _Strongest, descriptor_id: str, *, second: bool) -> Nodes:
    keys = codes.keys_of(codes.space(descriptor_id, second=second), nodes.types, nodes.codes)
    return Nodes(keys, nodes.codes, nodes.positions)


def _centred(*groups: list[Nodes]) -> list[Nodes]:
    """Each group as one, by key, about the mean of the first."""
    first = [nodes.positions for nodes in groups[0]]
    centre = np.concatenate(first).mean(0) if first else np.zeros(3)
    return [_joined(group, centre) for group in groups]


def _joined(parts: list[Nodes], centre: np.ndarray) -> Nodes:
    if not parts:
        return Nodes(np.zeros(0, np.int64), np.zeros((0, NUM_DIMS), np.int8), np.zeros((0, 3), np.float16))
    keys = np.concatenate([nodes.keys for nodes in parts])
    found = np.concatenate([nodes.codes for nodes in parts])
    positions = np.clip(np.concatenate([nodes.positions for nodes in parts]) - centre, -6e4, 6e4).astype(np.float16)
    order = np.argsort(keys, kind="stable")
    return Nodes(keys[order], found[order], positions[order])

"""Which pairs of scenes are worth registering, without trying all of them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.types import NodeLayer, SceneGraph

VERSION = 2

_MIN_NODES = 16  # of each scene, however many scenes share the budget
_BLOCK = 20_000_000  # entries of one product of similarities: 80 MB


@dataclass(frozen=True)
class Params:
    """Which pairs are tried.

    Args:
        top_k: most voted for scenes that each scene is paired with.
        votes_per_node: most similar nodes that each node votes for.
        nodes_per_scene: strongest nodes of a scene that vote and are voted for.
        max_nodes: of all scenes together; of many scenes fewer nodes each take part.
        num_spatial: nearest placed scenes of its component that each placed scene is paired with.
        reach_sigmas: two placed scenes may touch within this many standard deviations of their distance.
    """

    top_k: int = 10
    votes_per_node: int = 20
    nodes_per_scene: int = 400
    max_nodes: int = 60_000
    num_spatial: int = 12
    reach_sigmas: float = 3.0


@dataclass(frozen=True, eq=False)
class Placed:
    """Where a scene lies in the map, as far as that is known.

    Args:
        component: of the pose graph; components share no frame, so only scenes of one component can be neighbours.
        centre: (3,) of the scene's content, in the component's frame.
        radius: of its content, map units.
        sigma: standard deviation of its position, map units.
    """

    component: int
    centre: np.ndarray
    radius: float
    sigma: float = 0.0


def candidate_pairs(
    graphs: Sequence[SceneGraph],
    *,
    new: Collection[str] | None = None,
    placed: Mapping[str, Placed] | None = None,
    params: Params | None = None,
) -> list[tuple[str, str]]:
    """Pairs of scene ids that may overlap: votes of similar nodes, united with neighbours once poses exist.

    Nodes of one type vote for the scenes that hold the nodes most like them; a scene is paired with the ``top_k`` most
    voted for. Placed scenes are also paired with those of their component that their content may touch.

    Args:
        graphs: of all scenes, in any order.
        new: ids of scenes to find partners for; default all.
        placed: by scene id, what is known of where scenes lie.

    Returns:
        (lower, higher) by scene id, each pair once, most promising first, equals by id: a scene's id is the digest of
        its content, so the same scenes make the same pairs in the same direction, whichever came first.
    """
    params = params or Params()
    graphs = sorted(graphs, key=lambda graph: graph.scene_id)
    order = {graph.scene_id: i for i, graph in enumerate(graphs)}
    asked = [order[s] for s in order if new is None or s in new]
    scores: dict[tuple[int, int], float] = defaultdict(float)
    votes = _votes(graphs, asked, params)
    for row, scene in enumerate(asked):
        for other in np.argsort(-votes[row], kind="stable")[: params.top_k]:
            if votes[row, other] > 0 and other != scene:
                pair = (min(scene, int(other)), max(scene, int(other)))
                scores[pair] = max(scores[pair], float(votes[row, other]))
    for pair in _component_neighbours(graphs, asked, placed or {}, params):
        scores.setdefault(pair, 0.0)
    ranked = sorted(scores, key=lambda pair: (-scores[pair], pair))
    return [(graphs[a].scene_id, graphs[b].scene_id) for a, b in ranked]


def _votes(graphs: Sequence[SceneGraph], asked: Sequence[int], params: Params) -> np.ndarray:
    """(asked, scenes) sum of the similarities by which each scene's nodes vote for each other scene."""
    votes = np.zeros((len(asked), len(graphs)))
    budget = max(_MIN_NODES, min(params.nodes_per_scene, params.max_nodes // max(1, len(graphs))))
    # Layers of one descriptor are compared with each other; with guessed units a scene votes through several.
    descriptors: dict[str, list[tuple[int, NodeLayer]]] = defaultdict(list)
    upright = all(graph.up is not None for graph in graphs)
    for i, graph in enumerate(graphs):
        metric = {name for name in graph.layers if ":" not in name}
        for name, layer in sorted(graph.layers.items()):
            if upright and name.startswith("landmarks_gravity_free"):
                continue
            if len(layer) and (name in metric or name.split(":")[0] not in metric):
                descriptors[layer.descriptor_id].append((i, layer))
    row_of = {scene: row for row, scene in enumerate(asked)}
    for layers in descriptors.values():
        rows = [np.argsort(-layer.weights, kind="stable")[:budget] for _, layer in layers]
        scene = np.concatenate([np.full(len(r), i) for (i, _), r in zip(layers, rows, strict=True)])
        kinds = np.concatenate([layer.types[r] for (_, layer), r in zip(layers, rows, strict=True)])
        vectors = np.concatenate([layer.embeddings[r] for (_, layer), r in zip(layers, rows, strict=True)])
        asking = np.isin(scene, asked)
        for kind in np.unique(kinds):
            pool, voters = np.flatnonzero(kinds == kind), np.flatnonzero((kinds == kind) & asking)
            if not len(voters):  # no scene that is asked for has a node of this type
                continue
            for chunk in np.array_split(voters, len(voters) * len(pool) // _BLOCK + 1):
                similarity = vectors[chunk] @ vectors[pool].T
                similarity[scene[chunk][:, None] == scene[pool]] = -1.0
                k = min(params.votes_per_node, len(pool))
                best = np.argpartition(-similarity, k - 1, axis=1)[:, :k]
                weight = np.take_along_axis(similarity, best, axis=1)
                # How far a node stands out from the last of its k: common nodes are alike everywhere and say little.
                weight = np.maximum(weight - np.maximum(weight.min(1, keepdims=True), 0.0), 0.0)
                voter = np.array([row_of[s] for s in scene[chunk]])
                np.add.at(votes, (np.repeat(voter, k), scene[pool][best].ravel()), weight.ravel())
    return votes


def _component_neighbours(
    graphs: Sequence[SceneGraph], asked: Sequence[int], placed: Mapping[str, Placed], params: Params
) -> list[tuple[int, int]]:
    """Pairs of placed scenes of one component whose contents may touch."""
    known = [i for i, graph in enumerate(graphs) if graph.scene_id in placed]
    if len(known) < 2:
        return []
    at = [placed[graphs[i].scene_id] for i in known]
    centres = np.array([p.centre for p in at])
    radii, sigmas = np.array([p.radius for p in at]), np.array([p.sigma for p in at])
    components = np.array([p.component for p in at])
    pairs = []
    for k, i in enumerate(known):
        if i not in asked:
            continue
        distance = np.linalg.norm(centres - centres[k], axis=1)
        gap = distance - radii - radii[k] - params.reach_sigmas * np.hypot(sigmas, sigmas[k])
        gap[(components != components[k]) | (np.arange(len(known)) == k)] = np.inf
        touching = np.flatnonzero(gap <= 0)
        for j in touching[np.argsort(distance[touching], kind="stable")][: params.num_spatial]:
            pairs.append((min(i, known[j]), max(i, known[j])))
    return pairs

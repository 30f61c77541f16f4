"""The candidate pairs of scene graphs in memory, with a temporary index."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from gsmap.retrieve import Params, ScenePosition, directed, look_up, neighbours, new_segment, select_nodes
from gsmap.types import SceneGraph


def candidate_pairs(
    graphs: Sequence[SceneGraph],
    *,
    new: Collection[str] | None = None,
    positions: Mapping[str, ScenePosition] | None = None,
    params: Params | None = None,
) -> list[tuple[str, str]]:
    """Return pairs of scene ids that may overlap: each scene with its best candidates and with its neighbours by pose.

    Args:
        graphs: graphs of all scenes, in any order.
        new: ids of the query scenes; all by default.
        positions: positions of the scenes with poses, by scene id.
        params: settings of retrieval.

    Returns:
        Pairs (lower id, higher id), each once, best first; equally good pairs are sorted by id.
    """
    params = params or Params()
    scenes = [select_nodes(graph, "", params.nodes_per_scene) for graph in sorted(graphs, key=lambda g: g.scene_id)]
    queries = [one for one in scenes if new is None or one.member.scene in new]
    scores: dict[tuple[str, str], tuple[float, float]] = {}
    for one, found in zip(queries, look_up(queries, [new_segment(scenes)], params), strict=True):
        for candidate in found[: params.top_k]:
            pair = directed(one.member.scene, candidate.scene)
            scores[pair] = max(scores.get(pair, (0.0, 0.0)), (candidate.score, candidate.votes))
    known = {graph.scene_id for graph in graphs}
    for pair in neighbours({scene: at for scene, at in (positions or {}).items() if scene in known}, params):
        if new is None or set(pair) & set(new):
            scores.setdefault(pair, (0.0, 0.0))
    return sorted(scores, key=lambda pair: (-scores[pair][0], -scores[pair][1], pair))

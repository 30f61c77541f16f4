"""Candidate pairs of graphs that lie in memory: an index made for once, and what it says."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from gsmap.retrieve.index import new_segment
from gsmap.retrieve.lookup import look_up
from gsmap.retrieve.neighbours import Placed, neighbours
from gsmap.retrieve.params import Params
from gsmap.retrieve.rounds import Pair, directed
from gsmap.retrieve.voters import voters_of
from gsmap.types import SceneGraph


def candidate_pairs(
    graphs: Sequence[SceneGraph],
    *,
    new: Collection[str] | None = None,
    placed: Mapping[str, Placed] | None = None,
    params: Params | None = None,
) -> list[Pair]:
    """Pairs of scene ids that may overlap: the most promising scenes of each, united with neighbours once poses exist.

    Args:
        graphs: of all scenes, in any order.
        new: ids of scenes to find partners for; default all.
        placed: by scene id, what is known of where scenes lie.

    Returns:
        (lower, higher) by scene id, each pair once, most promising first, equals by id: a scene's id is the digest of
        its content, so the same scenes make the same pairs in the same direction, whichever came first.
    """
    params = params or Params()
    voters = [voters_of(graph, "", params.nodes_per_scene) for graph in sorted(graphs, key=lambda g: g.scene_id)]
    asking = [one for one in voters if new is None or one.member.scene in new]
    scores: dict[Pair, tuple[float, float]] = {}
    for one, found in zip(asking, look_up(asking, [new_segment(voters)], params), strict=True):
        for candidate in found[: params.top_k]:
            pair = directed(one.member.scene, candidate.scene)
            scores[pair] = max(scores.get(pair, (0.0, 0.0)), (candidate.score, candidate.votes))
    known = {graph.scene_id for graph in graphs}
    for pair in neighbours({scene: at for scene, at in (placed or {}).items() if scene in known}, params):
        if new is None or set(pair) & set(new):
            scores.setdefault(pair, (0.0, 0.0))
    return sorted(scores, key=lambda pair: (-scores[pair][0], -scores[pair][1], pair))

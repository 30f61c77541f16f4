"""Golden cases of this room: see tests/contracts."""

from collections.abc import Callable

import numpy as np
from retrieve_worlds import walk
from retrieved_pairs import candidate_pairs

from gsmap.retrieve import Params, ScenePosition


def _pairs() -> dict[str, np.ndarray]:
    graphs = walk(12)
    order = {graph.scene_id: i for i, graph in enumerate(graphs)}
    placed = {f"s{i:03}": ScenePosition(i // 8, np.array([2.0 * i, 0.0, 0.0]), 1.2, 0.1) for i in range(12)}
    found = {
        "votes": candidate_pairs(graphs, params=Params(top_k=3)),
        "placed": candidate_pairs(graphs, new={"s004", "s009"}, positions=placed, params=Params(top_k=2)),
    }
    return {name: np.array([(order[a], order[b]) for a, b in pairs]) for name, pairs in found.items()}


CASES: dict[str, Callable[[], dict[str, np.ndarray]]] = {"retrieve": _pairs}

"""Look up scenes in the retrieval index, after updating it and rebuilding damaged parts."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from gsmap import retrieve
from gsmap.errors import CorruptError, NotFoundError
from gsmap.map.scene_index import AT_ONCE, PATIENCE, SceneIndex
from gsmap.methods import RecipeKey
from gsmap.retrieve import SceneNodes
from gsmap.store import Store
from gsmap.store.indexes import Lookup
from gsmap.types import SceneGraph
from gsmap.types.progress import StageProgress
from gsmap.types.retrieval import Candidate
from gsmap.types.segments import InMemory, Segment

_AT_ONCE = 16  # scenes that ask together: what they find is in memory, some 7 MB of each
KEPT = 2
"""Ratio of candidates that are kept, for display, to candidates that are tried."""


def look_up_scenes(
    store: Store,
    graphs: Mapping[str, RecipeKey],
    asking: Sequence[str],
    params: retrieve.Params,
    beside: Collection[str],
    progress: StageProgress,
) -> None:
    """Look scenes up in the index and store the candidates.

    Args:
        graphs: graph key of every scene to index.
        asking: ids of the query scenes.
        beside: recipes of the other indexes of the map.
    """
    mine: dict[str, SceneNodes] = {}
    index = _index(store, graphs, params, set(asking), mine, beside)
    for left in reversed(range(PATIENCE)):
        try:
            segments = index.update(lambda told: progress("register", 0.0, f"{told} of retrieval"))
            for start in range(0, len(asking), _AT_ONCE):
                scenes = asking[start : start + _AT_ONCE]
                voters = [mine[scene] if scene in mine else _voters(store, graphs[scene], params) for scene in scenes]
                found = retrieve.look_up(voters, segments, params)
                store.indexes.save_lookups(
                    [_lookup(one, said, params) for one, said in zip(voters, found, strict=True)]
                )
            return
        except CorruptError:
            if not (left and index.forget_damaged()):
                raise
        except NotFoundError:  # another process made segments one while they were read
            if not left:
                raise


def look_up_graph(
    store: Store, graphs: Mapping[str, RecipeKey], graph: SceneGraph, params: retrieve.Params
) -> list[Candidate]:
    """Look up a graph that is not in the map, without storing it or changing the index.

    Args:
        graphs: graph key of every indexed scene; scenes missing in the index are read.
        graph: the query graph, made by the same recipe.
    """
    index = _index(store, graphs, params)
    for left in reversed(range(PATIENCE)):
        try:
            kept = index.segments()
            missing = index.missing(kept)
            parts = [missing[start : start + AT_ONCE] for start in range(0, len(missing), AT_ONCE)]
            segments: list[Segment] = [*kept, *(index.make(part) for part in parts)]
            asking = retrieve.select_nodes(graph, "", params.nodes_per_scene)
            return retrieve.look_up([asking], segments, params)[0]
        except NotFoundError:  # another process made segments one while they were read
            if not left:
                raise
        except CorruptError as error:
            raise CorruptError(
                f"{error}: gsmap register {store.home} rebuilds the index", code="index_damaged"
            ) from error
    raise AssertionError("unreachable")


def keys_of_lookups(graphs: Mapping[str, RecipeKey], params: retrieve.Params) -> dict[str, str]:
    """Return the key (digest) of each scene's stored lookup."""
    recipe = retrieve.recipe_key(params)
    return {scene: recipe.digest_of(key.digest) for scene, key in graphs.items()}


def _index(
    store: Store,
    graphs: Mapping[str, RecipeKey],
    params: retrieve.Params,
    asking: Collection[str] = (),
    read: dict[str, SceneNodes] | None = None,
    beside: Collection[str] = (),
) -> SceneIndex:
    """Return the scene index of the graphs.

    Args:
        read: receives the query scenes that were read while they were indexed.
        beside: recipes of the other indexes of the map.
    """

    def make(scenes: Sequence[str]) -> InMemory:
        new = [_voters(store, graphs[scene], params) for scene in scenes]
        if read is not None:
            read.clear()  # those before lie in the index
            read.update({voters.member.scene: voters for voters in new if voters.member.scene in asking})
        return retrieve.new_segment(new)

    keys = {scene: key.digest for scene, key in graphs.items()}
    return SceneIndex(store, retrieve.index_recipe(params), beside, keys, make)


def _voters(store: Store, key: RecipeKey, params: retrieve.Params) -> SceneNodes:
    graph = store.graphs.load(key.inputs[0], key)
    assert graph is not None
    return retrieve.select_nodes(graph, key.digest, params.nodes_per_scene)


def _lookup(voters: SceneNodes, said: Sequence[Candidate], params: retrieve.Params) -> Lookup:
    key = retrieve.recipe_key(params).of(voters.member.graph)
    return Lookup(voters.member.scene, key.digest, tuple(said[: KEPT * params.top_k]))
